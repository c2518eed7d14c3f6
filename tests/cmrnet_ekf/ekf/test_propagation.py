"""Propagation against finite differences, a fine integration and GTSAM's preintegration."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from moving_states import drive, error_between, moved, random_state

from cmrnet_ekf.ekf.ekf_settings import MotionConfig
from cmrnet_ekf.ekf.motion_state import SIZE, MotionState, cloned
from cmrnet_ekf.ekf.propagation import Propagation
from lcd_common import se3

_TEN_MS = 10_000_000


@pytest.mark.parametrize('coasts', [False, True])
@pytest.mark.parametrize('seed', range(3))
def test_the_covariance_moves_by_the_derivative_of_the_motion(seed: int, coasts: bool) -> None:
    rng = np.random.default_rng(seed)
    state = random_state(rng)
    if coasts:
        state = replace(state, turn_rate=None, force=None)
    quiet = MotionConfig(
        accelerometer_noise=1e-8, gyroscope_noise=1e-9, accelerometer_walk=0.0,
        gyroscope_walk=0.0, coast_acceleration=1e-6, coast_turn=1e-6,
    )  # fmt: skip
    propagation = Propagation(quiet)
    after = propagation.to(state, _TEN_MS)
    h = 1e-6
    F = np.empty((SIZE, SIZE))
    for i in range(SIZE):
        step = np.zeros(SIZE)
        step[i] = h
        ahead = propagation.to(moved(state, step), _TEN_MS)
        behind = propagation.to(moved(state, -step), _TEN_MS)
        F[:, i] = (error_between(ahead, after) - error_between(behind, after)) / (2 * h)
    expected = F @ state.covariance @ F.T
    # The sample's own approximation is of the order (turn rate dt)^2.
    np.testing.assert_allclose(after.covariance, expected, rtol=0, atol=2e-7)


def test_the_motion_is_that_of_a_fine_integration() -> None:
    truth = drive(5.0)
    state = MotionState(
        0, np.eye(3), np.zeros(3), truth.velocities[0], np.zeros(3), np.zeros(3), np.eye(SIZE)
    )
    propagation = Propagation(MotionConfig())
    for k in range(len(truth.stamps_ns) - 1):
        state = replace(
            state,
            turn_rate=truth.turn_rates[k],
            force=truth.forces[k],
            imu_ns=int(truth.stamps_ns[k]),
        )
        state = propagation.to(state, int(truth.stamps_ns[k + 1]))
    metres, radians = se3.distance(state.T_map_body, truth.T_map_body[-1])
    assert metres < 1e-3 and radians < 1e-9  # of 40 m


def test_mean_and_covariance_are_those_of_gtsam() -> None:
    """One second of samples; GTSAM's CombinedImuFactor sums up the same noise."""
    rng = np.random.default_rng(1)
    start = replace(random_state(rng), covariance=1e-30 * np.eye(SIZE))
    motion = MotionConfig(
        accelerometer_noise=0.03, gyroscope_noise=0.002, accelerometer_walk=0.01,
        gyroscope_walk=0.003,
    )  # fmt: skip
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(motion.gravity)
    params.setAccelerometerCovariance(np.eye(3) * motion.accelerometer_noise**2)
    params.setGyroscopeCovariance(np.eye(3) * motion.gyroscope_noise**2)
    params.setBiasAccCovariance(np.eye(3) * motion.accelerometer_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * motion.gyroscope_walk**2)
    params.setIntegrationCovariance(np.zeros((3, 3)))
    bias = gtsam.imuBias.ConstantBias(start.accelerometer_bias, start.gyroscope_bias)
    total = gtsam.PreintegratedCombinedMeasurements(params, bias)
    propagation, state = Propagation(motion), start
    dt_ns = 2_000_000
    for k in range(500):
        turn = np.array([0.3 * np.sin(0.01 * k), 0.1, 0.4])
        force = np.array([1.0, 0.2 * np.cos(0.02 * k), 9.7])
        total.integrateMeasurement(force, turn, dt_ns * 1e-9)
        state = replace(state, turn_rate=turn, force=force, imu_ns=k * dt_ns)
        state = propagation.to(state, (k + 1) * dt_ns)
    nav = gtsam.NavState(gtsam.Rot3(start.R), start.p, start.v)
    predicted = total.predict(nav, bias)
    metres, radians = se3.distance(state.T_map_body, predicted.pose().matrix())
    assert metres < 1e-3 and radians < 1e-5  # GTSAM sums in a tangent space
    np.testing.assert_allclose(state.v, predicted.velocity(), atol=2e-3)

    # GTSAM's order: rotation, position, velocity, accelerometer, gyroscope. Position and velocity
    # of its preintegrated sum are in the axes at the start, the rotation is a vector theta, and
    # exp(theta + d) = exp(theta) exp(J d).
    R_start_end = start.R.T @ state.R
    theta = total.deltaRij().matrix()
    J = _right_jacobian(se3.so3_log(theta))
    to_gtsam = np.zeros((SIZE, SIZE))
    to_gtsam[0:3, 3:6] = np.linalg.inv(J)
    to_gtsam[3:6, 0:3] = to_gtsam[6:9, 6:9] = R_start_end
    to_gtsam[9:12, 12:15] = to_gtsam[12:15, 9:12] = -np.eye(3)  # its residual's sign
    ours = to_gtsam @ state.covariance @ to_gtsam.T
    theirs = total.preintMeasCov()
    scale = np.sqrt(np.outer(np.diag(theirs), np.diag(theirs)))
    np.testing.assert_allclose(ours / scale, theirs / scale, atol=1e-3)


def _right_jacobian(theta: np.ndarray) -> np.ndarray:
    h = 1e-6
    columns = [
        se3.so3_log(se3.so3_exp(-theta) @ se3.so3_exp(theta + h * axis)) / h for axis in np.eye(3)
    ]
    return np.array(columns).T


def test_a_clone_keeps_its_pose_and_correlation() -> None:
    state = random_state(np.random.default_rng(3))
    later = Propagation(MotionConfig()).to(cloned(state, 'odom'), _TEN_MS)
    alone = Propagation(MotionConfig()).to(state, _TEN_MS)
    np.testing.assert_allclose(later.covariance[:SIZE, :SIZE], alone.covariance, atol=1e-12)
    np.testing.assert_array_equal(later.covariance[SIZE:, SIZE:], state.covariance[:6, :6])
    assert np.linalg.eigvalsh(later.covariance)[0] > -1e-12
    np.testing.assert_array_equal(later.clones[0].p, state.p)


def test_without_samples_the_vehicle_coasts_and_becomes_uncertain() -> None:
    settings = MotionConfig(imu_hold=0.1)
    state = random_state(np.random.default_rng(4))
    held = Propagation(settings).to(state, 100_000_000)
    coasted = Propagation(settings).to(state, 1_100_000_000)
    assert coasted.turn_rate is None
    np.testing.assert_allclose(coasted.p, held.p + held.v, atol=1e-12)
    np.testing.assert_array_equal(coasted.R, held.R)
    grown = np.diag(coasted.covariance - held.covariance)
    np.testing.assert_allclose(grown[3:6], settings.coast_turn**2, rtol=1e-9)
    np.testing.assert_allclose(grown[6:9], settings.coast_acceleration**2, rtol=1e-9)


def test_two_half_steps_are_one_step() -> None:
    propagation = Propagation(MotionConfig())
    state = random_state(np.random.default_rng(5))
    once = propagation.to(state, _TEN_MS)
    twice = propagation.to(propagation.to(state, _TEN_MS // 2), _TEN_MS)
    np.testing.assert_allclose(twice.p, once.p, atol=1e-7)
    np.testing.assert_allclose(twice.v, once.v, atol=1e-6)
    np.testing.assert_allclose(twice.R, once.R, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, once.covariance, atol=2e-7)
