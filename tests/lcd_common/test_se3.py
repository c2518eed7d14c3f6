"""SE(3) against scipy, GTSAM and finite differences."""

import gtsam
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from lcd_common import se3

RNG = np.random.default_rng(0)


def random_twist(scale: float = 1.0) -> np.ndarray:
    return RNG.normal(0.0, scale, 6)


def random_covariance() -> np.ndarray:
    A = RNG.normal(size=(6, 6))
    return A @ A.T * 1e-4 + 1e-6 * np.eye(6)


def wedge(xi: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = se3.hat(xi[3:])
    matrix[:3, 3] = xi[:3]
    return matrix


@pytest.mark.parametrize('scale', [1e-10, 1e-6, 1e-3, 0.3, 1.0])
def test_exp_is_the_matrix_exponential_and_log_inverts_it(scale: float) -> None:
    for _ in range(20):
        xi = random_twist(scale)
        np.testing.assert_allclose(se3.exp(xi), expm(wedge(xi)), atol=1e-12)
        if np.linalg.norm(xi[3:]) < np.pi:
            np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


def test_exp_agrees_with_gtsam_after_reordering() -> None:
    xi = random_twist()
    np.testing.assert_allclose(
        se3.exp(xi), gtsam.Pose3.Expmap(np.r_[xi[3:], xi[:3]]).matrix(), atol=1e-12
    )


def test_log_of_half_turns_has_angle_pi() -> None:
    for axis in np.eye(3):
        T = se3.exp(np.r_[1.0, 2.0, 3.0, np.pi * axis])
        assert se3.rotation_angle(T) == pytest.approx(np.pi)
        np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-9)


def test_quaternions_agree_with_scipy() -> None:
    for rotation in Rotation.random(200, random_state=1):
        q = se3.quaternion_from_rotation(rotation.as_matrix())
        np.testing.assert_allclose(q, rotation.as_quat(canonical=True), atol=1e-12)
        T = se3.from_xyz_quaternion([1, 2, 3], 7.0 * q)
        np.testing.assert_allclose(T[:3, :3], rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize('quaternion', [[0, 0, 0, 0], [np.nan, 0, 0, 1]])
def test_a_quaternion_without_length_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(ValueError, match='quaternion must have a length'):
        se3.from_xyz_quaternion([0, 0, 0], quaternion)


def test_inverse_works_on_stacks() -> None:
    stack = np.array([se3.exp(random_twist()) for _ in range(5)])
    np.testing.assert_allclose(se3.inverse(stack), np.linalg.inv(stack), atol=1e-12)


def test_adjoint_moves_a_perturbation_across() -> None:
    T, xi = se3.exp(random_twist()), random_twist(0.1)
    moved = T @ se3.exp(xi) @ se3.inverse(T)
    np.testing.assert_allclose(se3.exp(se3.adjoint(T) @ xi), moved, atol=1e-12)


def test_compose_and_invert_covariance_agree_with_monte_carlo() -> None:
    T_a_b, T_b_c = se3.exp(random_twist()), se3.exp(random_twist())
    S_ab, S_bc = random_covariance(), random_covariance()
    n = 40_000
    e_ab = RNG.multivariate_normal(np.zeros(6), S_ab, n)
    e_bc = RNG.multivariate_normal(np.zeros(6), S_bc, n)
    T_a_c_inverse = se3.inverse(T_a_b @ T_b_c)
    errors = np.array(
        [
            se3.log(T_a_c_inverse @ T_a_b @ se3.exp(p) @ T_b_c @ se3.exp(q))
            for p, q in zip(e_ab[:4000], e_bc[:4000], strict=True)
        ]
    )
    predicted = se3.compose_covariance(S_ab, T_b_c, S_bc)
    ratio = np.linalg.eigvals(np.linalg.solve(predicted, np.cov(errors.T))).real
    assert np.all((ratio > 0.88) & (ratio < 1.14))

    inverted = np.array([se3.log(T_a_b @ se3.inverse(T_a_b @ se3.exp(p))) for p in e_ab[:4000]])
    predicted = se3.invert_covariance(T_a_b, S_ab)
    ratio = np.linalg.eigvals(np.linalg.solve(predicted, np.cov(inverted.T))).real
    assert np.all((ratio > 0.88) & (ratio < 1.14))


def test_ros_covariance_is_translation_first_about_the_parents_axes() -> None:
    # A car that drives north (+y of the map): uncertain along its own x axis is uncertain in map y.
    T_map_base = se3.rotation_z(np.pi / 2)
    body = np.diag([4.0, 1.0, 1.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        np.diag(se3.ros_covariance(T_map_base, body)), [1.0, 4.0, 1.0, 0.2, 0.1, 0.3], atol=1e-12
    )
    S, T = random_covariance(), se3.exp(random_twist())
    np.testing.assert_allclose(se3.covariance_from_ros(T, se3.ros_covariance(T, S)), S, atol=1e-15)


def test_gtsam_covariance_is_rotation_first() -> None:
    body = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    np.testing.assert_allclose(np.diag(se3.gtsam_covariance(body)), [4, 5, 6, 1, 2, 3])
    S = random_covariance()
    np.testing.assert_allclose(se3.covariance_from_gtsam(se3.gtsam_covariance(S)), S)

    # GTSAM itself: a factor with our covariance has the Mahalanobis distance that we compute.
    T, xi = se3.exp(random_twist()), random_twist(0.01)
    noise = gtsam.noiseModel.Gaussian.Covariance(se3.gtsam_covariance(S))
    factor = gtsam.PriorFactorPose3(0, gtsam.Pose3(T), noise)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(T @ se3.exp(xi)))
    assert factor.error(values) == pytest.approx(0.5 * xi @ np.linalg.solve(S, xi), rel=1e-6)


def test_is_covariance_refuses_what_a_filter_must_not_take() -> None:
    S = random_covariance()
    assert se3.is_covariance(S)
    skewed = S.copy()
    skewed[0, 1] += 1e-3
    assert not se3.is_covariance(skewed)
    assert not se3.is_covariance(S * np.nan)
    assert not se3.is_covariance(-S)
    assert not se3.is_covariance(np.zeros((6, 6)))


def test_interpolate_reaches_both_ends_and_halves_the_way() -> None:
    T_a_b, T_a_c = se3.exp(random_twist()), se3.exp(random_twist())
    np.testing.assert_allclose(se3.interpolate(T_a_b, T_a_c, 0.0), T_a_b, atol=1e-12)
    np.testing.assert_allclose(se3.interpolate(T_a_b, T_a_c, 1.0), T_a_c, atol=1e-9)
    middle = se3.interpolate(T_a_b, T_a_c, 0.5)
    np.testing.assert_allclose(
        se3.log(se3.inverse(T_a_b) @ middle), se3.log(se3.inverse(middle) @ T_a_c), atol=1e-9
    )


def test_transform_points_keeps_the_dtype() -> None:
    T = se3.exp(random_twist())
    points = RNG.normal(size=(7, 3)).astype(np.float32)
    moved = se3.transform_points(T, points)
    assert moved.dtype == np.float32
    homogeneous = np.c_[points.astype(float), np.ones(7)] @ T.T
    np.testing.assert_allclose(moved, homogeneous[:, :3], atol=1e-5)
    assert se3.yaw(se3.rotation_z(2.5)) == pytest.approx(2.5)
