"""The thesis's filter: equation (33), its limit, its Jacobian, and batch least squares."""

import numpy as np
import pytest

from cmrnet_ekf.thesis_ekf import (
    ThesisEkf,
    ThesisEkfConfig,
    motion,
    motion_jacobian,
    pose_matrix,
    pose_vector,
    wrapped,
)
from lcd_common import se3
from lcd_common.errors import DataError


@pytest.mark.parametrize('turn_rate', [0.5, -0.3, 1e-2])
def test_the_motion_is_equation_33_as_printed(turn_rate: float) -> None:
    state, v, dt = np.array([1.0, 2.0, 3.0, 0.1, -0.1, 0.7]), 9.0, 0.1
    x, y, _, _, _, theta = state
    printed = [
        x - v / turn_rate * np.sin(theta) + v / turn_rate * np.sin(theta + turn_rate * dt),
        y + v / turn_rate * np.cos(theta) - v / turn_rate * np.cos(theta + turn_rate * dt),
    ]
    after = motion(state, v, turn_rate, dt)
    np.testing.assert_allclose(after[:2], printed, atol=1e-10)
    np.testing.assert_allclose(after[2:], [3.0, 0.1, -0.1, 0.7 + turn_rate * dt])


@pytest.mark.parametrize('turn_rate', [0.0, 1e-12, -1e-9, 1e-5])
def test_on_the_straight_it_is_the_limit(turn_rate: float) -> None:
    state = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    after = motion(state, 10.0, turn_rate, 1.0)
    np.testing.assert_allclose(after[:2], [10 * np.cos(0.5), 10 * np.sin(0.5)], atol=1e-4)


@pytest.mark.parametrize('turn_rate', [0.0, 1e-7, 0.4, -2.0])
def test_its_jacobian_is_the_derivative(turn_rate: float) -> None:
    state, h = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 2.5]), 1e-6
    numeric = np.empty((6, 6))
    for i in range(6):
        step = np.zeros(6)
        step[i] = h
        ahead, behind = (motion(state + s, 8.0, turn_rate, 0.1) for s in (step, -step))
        numeric[:, i] = (ahead - behind) / (2 * h)
    np.testing.assert_allclose(motion_jacobian(state, 8.0, turn_rate, 0.1), numeric, atol=1e-8)


def test_the_letters_stand_for_what_the_thesis_means() -> None:
    """P0 and the motion's covariance are the preset's; the measurement's comes with it."""
    ekf = ThesisEkf(ThesisEkfConfig(), np.eye(4))
    np.testing.assert_array_equal(np.diag(ekf.covariance), [0.5] * 3 + [0.125] * 3)
    ekf.predict(0.0, 0.0, 0.1)
    np.testing.assert_allclose(np.diag(ekf.covariance), [1.0] * 3 + [0.1875] * 3)
    ekf.update(np.eye(4), np.diag([1.0] * 3 + [0.1875] * 3))
    np.testing.assert_allclose(np.diag(ekf.covariance), [0.5] * 3 + [0.1875 / 2] * 3)


def test_on_the_straight_it_is_batch_least_squares() -> None:
    """Speed along x, no turn, yaw known: linear, so the filter must be the least squares."""
    rng = np.random.default_rng(0)
    tight = ThesisEkfConfig(start_rotation=1e-18, motion_rotation=1e-18)
    ekf = ThesisEkf(tight, np.eye(4))
    steps, v, dt = 15, 10.0, 0.1
    sigma = np.array([0.3, 0.2, 0.5, 1e3, 1e3, 1e3])
    rows, values = [np.eye(3, 3 * steps + 3) / np.sqrt(0.5)], [np.zeros(3)]
    for k in range(steps):
        measured = np.array([v * dt * (k + 1), 0.0, 0.0]) + rng.normal(size=3)
        ekf.predict(v, 0.0, dt)
        ekf.update(se3.from_rotation_translation(np.eye(3), measured), np.diag(sigma**2))
        moved = np.zeros((3, 3 * steps + 3))
        moved[:, 3 * k : 3 * k + 3], moved[:, 3 * k + 3 : 3 * k + 6] = -np.eye(3), np.eye(3)
        seen = np.zeros((3, 3 * steps + 3))
        seen[:, 3 * k + 3 : 3 * k + 6] = np.eye(3)
        rows += [moved / np.sqrt(0.5), seen / sigma[:3, None]]
        values += [np.array([v * dt, 0.0, 0.0]) / np.sqrt(0.5), measured / sigma[:3]]
    A, b = np.concatenate(rows), np.concatenate(values)
    solution = np.linalg.lstsq(A, b, rcond=None)[0]
    covariance = np.linalg.inv(A.T @ A)[-3:, -3:]
    np.testing.assert_allclose(ekf.T_map_base[:3, 3], solution[-3:], atol=1e-6)
    np.testing.assert_allclose(ekf.covariance[:3, :3], covariance, atol=1e-6)


def test_angles_meet_behind_the_back() -> None:
    start = pose_matrix(np.array([0, 0, 0, 0, 0, np.pi - 0.05]))
    ekf = ThesisEkf(ThesisEkfConfig(), start)
    ekf.update(pose_matrix(np.array([0, 0, 0, 0, 0, -np.pi + 0.05])), 0.125 * np.eye(6))
    assert abs(abs(pose_vector(ekf.T_map_base)[5]) - np.pi) < 1e-9


def test_poses_and_vectors_are_the_same_thing() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        vector = rng.uniform(-1.4, 1.4, size=6)
        np.testing.assert_allclose(pose_vector(pose_matrix(vector)), vector, atol=1e-12)
    np.testing.assert_allclose(wrapped(np.array([9, 9, 9, 4, -4, 7.0]))[:3], 9)


def test_what_is_no_number_is_refused_and_changes_nothing() -> None:
    ekf = ThesisEkf(ThesisEkfConfig(), np.eye(4))
    for speed, dt in ((np.nan, 0.1), (np.inf, 0.1), (1.0, -0.1)):
        with pytest.raises(DataError):
            ekf.predict(speed, 0.0, dt)
    broken = np.full((4, 4), np.nan)
    for pose, covariance in ((broken, np.eye(6)), (np.eye(4), -np.eye(6))):
        with pytest.raises(DataError):
            ekf.update(pose, covariance)
    np.testing.assert_array_equal(ekf.T_map_base, np.eye(4))
