"""Covariances keep their order and axes on the way into GTSAM and back."""

import gtsam
import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig, between, diagonal, gaussian

T = se3.exp([3.0, -2.0, 0.5, 0.2, -0.1, 0.9])


def random_covariance(seed: int, scale: float = 1.0) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(6, 6)) * scale
    return A @ A.T + 0.1 * scale**2 * np.eye(6)


def test_gtsam_puts_rotation_first_and_perturbs_on_the_right() -> None:
    xi = np.array([0.3, -0.2, 0.1, 0.05, 0.2, -0.3])
    moved = gtsam.Pose3(T).retract(np.concatenate([xi[3:], xi[:3]]))
    np.testing.assert_allclose(moved.matrix(), T @ se3.exp(xi), atol=1e-12)
    adjoint = gtsam.Pose3(T).AdjointMap()
    np.testing.assert_allclose(se3.covariance_from_gtsam(adjoint), se3.adjoint(T), atol=1e-12)


def test_a_between_factor_weighs_errors_by_our_covariance() -> None:
    covariance = random_covariance(0)
    factor = between(0, 1, T, gaussian(covariance))
    rng = np.random.default_rng(1)
    for _ in range(20):
        xi = rng.normal(size=6) * 0.1
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3())
        values.insert(1, gtsam.Pose3(T @ se3.exp(xi)))
        expected = xi @ np.linalg.solve(covariance, xi)
        assert 2.0 * factor.error(values) == pytest.approx(expected, rel=1e-6)


def test_the_marginal_of_a_noisy_chain_agrees_with_drawn_samples() -> None:
    # Oracle: three thousand drawn chains, in plain numpy.
    rng = np.random.default_rng(2)
    covariances = [random_covariance(k, 0.01) for k in (3, 4)]
    samples = []
    factors = [np.linalg.cholesky(c) for c in covariances]
    for _ in range(3_000):
        drawn = np.eye(4)
        for L in factors:
            drawn = drawn @ T @ se3.exp(L @ rng.normal(size=6))
        samples.append(se3.log(se3.inverse(T @ T) @ drawn))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gaussian(diagonal(1e-6, 1e-6))))
    for k in range(3):
        values.insert(k, gtsam.Pose3(np.linalg.matrix_power(T, k)))
        if k:
            graph.add(between(k - 1, k, T, gaussian(covariances[k - 1])))
    marginal = se3.covariance_from_gtsam(gtsam.Marginals(graph, values).marginalCovariance(2))
    scale = np.sqrt(np.outer(np.diag(marginal), np.diag(marginal)))
    np.testing.assert_allclose(np.cov(np.array(samples).T) / scale, marginal / scale, atol=0.1)


def test_unknown_odometry_noise_grows_with_the_root_of_the_way() -> None:
    noise = GraphNoise(GraphNoiseConfig(odometry_translation_floor=1e-6))
    near, far = (noise.odometry(se3.exp([d, 0, 0, 0, 0, 0]), None)[0, 0] for d in (1.0, 4.0))
    assert far == pytest.approx(4.0 * near, rel=1e-6)


def test_floors_are_added_to_what_a_source_tells() -> None:
    noise = GraphNoise(GraphNoiseConfig(loop_translation_floor=0.3, loop_rotation_floor=0.04))
    told = random_covariance(5, 0.01)
    np.testing.assert_allclose(noise.loop(told), told + diagonal(0.3, 0.04))


@pytest.mark.parametrize('bad', [np.zeros((6, 6)), np.full((6, 6), np.nan), -np.eye(6)])
def test_what_is_no_covariance_counts_as_unknown(bad: np.ndarray) -> None:
    noise = GraphNoise(GraphNoiseConfig())
    np.testing.assert_array_equal(noise.loop(bad), noise.loop(None))
    np.testing.assert_array_equal(noise.odometry(T, bad), noise.odometry(T, None))
