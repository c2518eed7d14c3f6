"""The thesis's filter: equation (33), its limit, its Jacobian, and batch least squares."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
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


@dataclass(frozen=True)
class _TurningDrive:
    """A filter's bends, and the linear problem that it solved on the way, angles unwrapped.

    Attributes:
        ekf: the filter after the last step.
        start: mean of the prior [6].
        G, moved: of each step, x' = moved + G (x - at): linearised where the filter was [n x ...].
        at: where it was [n x 6].
        measured, covariances: poses [n x 6] and their covariances.
    """

    ekf: ThesisEkf
    start: se3.Array
    G: se3.Array
    moved: se3.Array
    at: se3.Array
    measured: se3.Array
    covariances: se3.Array


def _printed_33(state: se3.Array, v: float, turn_rate: float, dt: float) -> se3.Array:
    """Equation (33) as printed; also for complex numbers."""
    radius, theta, turned = v / turn_rate, state[5], state[5] + turn_rate * dt
    out = state.copy()
    out[0] += radius * (np.sin(turned) - np.sin(theta))
    out[1] += radius * (np.cos(theta) - np.cos(turned))
    out[5] = turned
    return out


def _turning_drive(steps: int = 25, v: float = 9.0, dt: float = 0.1) -> _TurningDrive:
    rng = np.random.default_rng(3)
    # Noise of all six, much of it correlated, and a heading that passes the back.
    truth = np.array([4.0, -2.0, 0.5, 0.05, -0.04, 2.2])
    start = truth + rng.normal(size=6) * [0.5, 0.5, 0.3, 0.1, 0.1, 0.2]
    ekf = ThesisEkf(ThesisEkfConfig(), pose_matrix(start))
    G, moved, at, measured, covariances = [], [], [], [], []
    for k in range(steps):
        turn_rate = 0.9 if k < 18 else -0.6
        here = truth + wrapped(pose_vector(ekf.T_map_base) - truth)
        # The complex step gives derivatives to the last digit, whoever's they are.
        columns = [_printed_33(here + 1e-30j * e, v, turn_rate, dt).imag / 1e-30 for e in np.eye(6)]
        G.append(np.array(columns).T)
        at.append(here)
        moved.append(_printed_33(here, v, turn_rate, dt))
        truth = _printed_33(truth, v, turn_rate, dt)
        root = rng.normal(size=(6, 6)) * np.array([[0.4, 0.3, 0.3, 0.05, 0.05, 0.1]]).T
        covariances.append(root @ root.T + np.diag([0.01] * 3 + [1e-4] * 3))
        measured.append(truth + np.linalg.cholesky(covariances[-1]) @ rng.normal(size=6))
        ekf.predict(v, turn_rate, dt)
        ekf.update(pose_matrix(measured[-1]), covariances[-1])
    lists = (G, moved, at, measured, covariances)
    return _TurningDrive(ekf, start, *(np.array(values) for values in lists))


def _least_squares(drive: _TurningDrive) -> tuple[se3.Array, se3.Array]:
    """Solve for all poses at once; return mean and covariance of the last."""
    n = len(drive.G)
    rows, values = [], []

    def row(sqrt_information: se3.Array, value: se3.Array, *blocks: tuple[int, se3.Array]) -> None:
        A = np.zeros((6, 6 * n + 6))
        for i, block in blocks:
            A[:, 6 * i : 6 * i + 6] = block
        rows.append(sqrt_information @ A)
        values.append(sqrt_information @ value)

    row(np.diag([0.5**-0.5] * 3 + [0.125**-0.5] * 3), drive.start, (0, np.eye(6)))
    moves = np.diag([0.5**-0.5] * 3 + [0.0625**-0.5] * 3)
    for k in range(n):
        constant = drive.moved[k] - drive.G[k] @ drive.at[k]
        row(moves, constant, (k, -drive.G[k]), (k + 1, np.eye(6)))
        sees = np.linalg.inv(np.linalg.cholesky(drive.covariances[k]))
        row(sees, drive.measured[k], (k + 1, np.eye(6)))
    A, b = np.concatenate(rows), np.concatenate(values)
    mean = np.linalg.lstsq(A, b, rcond=None)[0][-6:]
    return mean, np.linalg.inv(A.T @ A)[-6:, -6:]


def _gtsam(drive: _TurningDrive) -> tuple[se3.Array, se3.Array]:
    """Solve the same as a linear Gaussian factor graph."""
    graph = gtsam.GaussianFactorGraph()
    noise = gtsam.noiseModel.Diagonal.Variances
    prior, moves = (np.array([0.5] * 3 + [rotation] * 3) for rotation in (0.125, 0.0625))
    graph.push_back(gtsam.JacobianFactor(0, np.eye(6), drive.start, noise(prior)))
    for k, G in enumerate(drive.G):
        constant = drive.moved[k] - G @ drive.at[k]
        graph.push_back(gtsam.JacobianFactor(k, -G, k + 1, np.eye(6), constant, noise(moves)))
        # A JacobianFactor takes independent rows only: this is the information form.
        information, z = np.linalg.inv(drive.covariances[k]), drive.measured[k]
        seen = gtsam.HessianFactor(k + 1, information, information @ z, z @ information @ z)
        graph.push_back(seen)
    solution, last = graph.optimize(), len(drive.G)
    return solution.at(last), gtsam.Marginals(graph, solution).marginalCovariance(last)


@pytest.mark.parametrize('solve', [_least_squares, _gtsam])
def test_through_bends_it_is_the_batch_solution(
    solve: Callable[[_TurningDrive], tuple[se3.Array, se3.Array]],
) -> None:
    """Linearised where the filter was, the problem is linear: the last posterior is the batch's."""
    drive = _turning_drive()
    mean, covariance = solve(drive)
    off = wrapped(pose_vector(drive.ekf.T_map_base) - mean)
    np.testing.assert_allclose(off, 0.0, atol=1e-8)
    np.testing.assert_allclose(drive.ekf.covariance, covariance, rtol=1e-8, atol=1e-10)
    assert mean[5] > np.pi  # it turned past its back, and the filter's own angle leapt
    # Position and heading depend on each other: not just the diagonal was compared.
    assert abs(covariance[0, 5]) > 1e-4


def test_a_step_is_that_of_the_information_form() -> None:
    """Y = P^-1 + R^-1 and y = P^-1 x + R^-1 z, from a predicted state whose covariance is full."""
    before = _turning_drive(steps=10).ekf
    before.predict(9.0, -0.4, 0.1)
    x, P = pose_vector(before.T_map_base), before.covariance
    z = x + np.array([0.8, -0.6, 0.2, 0.02, -0.03, 0.25])
    R = np.diag([0.3, 0.1, 0.2, 0.01, 0.02, 0.03]) + 0.005
    before.update(pose_matrix(z), R)
    Y = np.linalg.inv(P) + np.linalg.inv(R)
    mean = np.linalg.solve(Y, np.linalg.solve(P, x) + np.linalg.solve(R, z))
    np.testing.assert_allclose(wrapped(pose_vector(before.T_map_base) - mean), 0.0, atol=1e-10)
    np.testing.assert_allclose(before.covariance, np.linalg.inv(Y), atol=1e-12)


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
