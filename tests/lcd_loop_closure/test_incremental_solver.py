"""The array of poses is iSAM2's estimate, however it was brought up to date."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from lcd_common import se3
from lcd_loop_closure.graph_noise import between, diagonal, gauge, gaussian
from lcd_loop_closure.incremental_solver import IncrementalConfig, IncrementalSolver
from lcd_loop_closure.weighted_graph import poses_of

MOTION = se3.exp([2.0, 0.1, 0, 0, 0.02, 0.1])


def circle(solver: IncrementalSolver, count: int, seed: int = 0) -> list[int]:
    """Drive circles with loops one round back; compare after every update; return loop handles."""
    rng = np.random.default_rng(seed)
    noise, loop_noise = gaussian(diagonal(0.02, 5e-3)), gaussian(diagonal(0.05, 5e-3))
    handles, T_guess = [], np.eye(4)
    truth = [np.linalg.matrix_power(MOTION, k) for k in range(count)]
    for row in range(count):
        solver.add_pose(T_guess)
        if row == 0:
            solver.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gauge()))
        else:
            measured = se3.inverse(truth[row - 1]) @ truth[row]
            measured = measured @ se3.exp(rng.normal(size=6) * np.repeat([0.02, 5e-3], 3))
            solver.add(between(X(row - 1), X(row), measured, noise))
            if row > 62 and row % 5 == 0:
                T_loop = se3.inverse(truth[row - 62]) @ truth[row]
                factor = between(X(row - 62), X(row), T_loop, loop_noise)
                handles.append(solver.add(factor))
        solver.update()
        if row % 3 == 0:  # two updates are read at once now and then
            estimate = poses_of(solver._isam.calculateEstimate())
            np.testing.assert_allclose(solver.poses, estimate, atol=2e-4)
            np.testing.assert_allclose(solver.pose(row), estimate[row], atol=1e-12)
        T_guess = solver.pose(row) @ MOTION
    return handles


@pytest.mark.parametrize('careful', [False, True])
def test_poses_follow_isam2(careful: bool) -> None:
    settings = IncrementalConfig(relinearize_translation=0.05, relinearize_rotation=0.01)
    solver = IncrementalSolver(settings, careful=careful)
    handles = circle(solver, 150)
    assert len(handles) == 17
    with_loops = solver.poses.copy()
    for handle in handles:
        solver.remove(handle)
    for _ in range(10):
        solver.update()
    assert np.abs(solver.poses - with_loops).max() > 0.05
    estimate = poses_of(solver._isam.calculateEstimate())
    np.testing.assert_allclose(solver.poses, estimate, atol=2e-4)


def test_covariances_are_those_of_a_batch_solve() -> None:
    solver = IncrementalSolver(IncrementalConfig(relinearize_translation=1e-4, wildfire=0.0))
    circle(solver, 80)
    for _ in range(5):
        solver.update()
    factors, values = solver._isam.getFactorsUnsafe(), solver._isam.calculateEstimate()
    marginals = gtsam.Marginals(factors, values)
    expected = se3.covariance_from_gtsam(marginals.marginalCovariance(X(70)))
    np.testing.assert_allclose(solver.pose_covariance(70), expected, rtol=1e-3, atol=1e-7)
    # Relative: against samples of the joint marginal, drawn in plain numpy.
    joint = marginals.jointMarginalCovariance([X(20), X(70)]).fullMatrix()
    L = np.linalg.cholesky(joint)
    rng = np.random.default_rng(1)
    T_20, T_70 = solver.pose(20), solver.pose(70)
    T_mean = se3.inverse(T_20) @ T_70
    drawn = []
    for _ in range(3000):
        xi = L @ rng.normal(size=12)
        a, b = (np.concatenate([x[3:], x[:3]]) for x in (xi[:6], xi[6:]))
        moved = se3.inverse(T_20 @ se3.exp(a)) @ T_70 @ se3.exp(b)
        drawn.append(se3.log(se3.inverse(T_mean) @ moved))
    measured = solver.relative_covariance(20, 70)
    scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
    np.testing.assert_allclose(np.cov(np.array(drawn).T) / scale, measured / scale, atol=0.1)
