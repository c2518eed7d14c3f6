"""Which observations are believed, and how the filter comes back when it was wrong."""

from dataclasses import replace

import numpy as np
import pytest
from followed_drive import (
    CAMERA,
    MOTION,
    START,
    START_POSE,
    TRUTH,
    camera,
    feed,
    follow,
    off_truth,
    started,
)

from cmrnet_ekf.ekf.ekf_settings import EkfSettings, GateConfig
from cmrnet_ekf.ekf.observations import PoseObservation, PositionObservation
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from lcd_common import se3


def test_five_seconds_without_a_camera_are_survived() -> None:
    ekf = started()
    follow(ekf, 300)
    before = ekf.estimate()
    feed(ekf, 300, 800)
    during = ekf.estimate()
    assert before is not None and during is not None
    assert np.trace(during.covariance) > 10 * np.trace(before.covariance)
    assert ekf.observe(camera(800)).accepted
    assert off_truth(ekf, 800) < 0.1


@pytest.mark.parametrize('alike', [False, True])
def test_a_hundred_wrong_observations_in_a_row_are_survived(alike: bool) -> None:
    """Each wrong in its own way: all are refused. All alike: it gives in, and back."""
    rng = np.random.default_rng(0)
    ekf = started()
    directions = rng.uniform(-np.pi, np.pi, 100)
    lies = [np.array([20 * np.cos(d), 20 * np.sin(d), 0, 0, 0, 0]) for d in directions]
    if alike:
        lies = [np.array([12.0, 5.0, 0, 0, 0, 0])] * 100
    accepted = 0
    for k in range(1, 1101):
        feed(ekf, k - 1, k)
        if k <= 50 and k % 5 == 0:
            assert ekf.observe(camera(k)).accepted
        elif 50 < k <= 550 and k % 5 == 0:
            accepted += ekf.observe(camera(k, lies[(k - 55) // 5])).accepted
        elif k > 550 and k % 5 == 0:
            ekf.observe(camera(k))
    assert (accepted > 50) if alike else (accepted == 0)
    assert off_truth(ekf, 1100) < 0.15


def test_the_gate_looks_at_the_whole_covariance_and_at_the_degrees() -> None:
    ekf = started(EkfSettings(motion=MOTION, start=START, gate=GateConfig(probability=0.99)))
    estimate = ekf.estimate()
    assert estimate is not None
    S = np.sqrt(START_POSE[0, 0] + CAMERA[0, 0])
    # One axis: the 99 % limit of one degree is 2.576 sigmas, of six it is 4.1.
    for sigmas, accepted in ((2.5, True), (2.65, False)):
        T = TRUTH.T_map_body[0] @ se3.exp([sigmas * S, 0, 0, 0, 0, 0])
        ekf = started(EkfSettings(motion=MOTION, start=START, gate=GateConfig(probability=0.99)))
        one = PoseObservation(0, 'camera', T, CAMERA, axes=(True, *(False,) * 5))
        assert ekf.observe(one).accepted is accepted
        ekf = started(EkfSettings(motion=MOTION, start=START, gate=GateConfig(probability=0.99)))
        assert ekf.observe(replace(one, axes=(True,) * 6)).accepted


def test_correlated_observations_count_for_what_they_are_worth() -> None:
    """A standing vehicle: n observations of correlation a are worth n (1 - a) / (1 + a)."""
    still = EkfSettings(motion=replace(MOTION, imu_hold=10.0, coast_turn=1e-6,
                                       coast_acceleration=1e-6))  # fmt: skip
    ekf = VehicleEkf(still)
    ekf.start(0, np.eye(4), np.diag([1e4] * 3 + [1e-6] * 3), velocity_sigma=1e-9)
    n, dt, correlation_s = 200, 0.1, 0.5
    for k in range(1, n + 1):
        seen = PoseObservation(
            round(k * dt * 1e9), 'camera', np.eye(4), CAMERA, correlation_s=correlation_s
        )
        ekf.observe(seen)
    estimate = ekf.estimate()
    assert estimate is not None
    a = np.exp(-dt / correlation_s)
    worth = 1 + (n - 1) * (1 - a) / (1 + a)
    assert estimate.covariance[0, 0] == pytest.approx(CAMERA[0, 0] / worth, rel=1e-3)


def test_a_minority_does_not_win_over_an_accepted_pose() -> None:
    """Fixes that agree with each other, wrongly (a reflection), while the camera is accepted."""
    ekf = started()
    shift = np.array([8.0, 0.0, 0.0])
    for k in range(1, 1001):
        feed(ekf, k - 1, k)
        if k % 10 == 0:
            assert ekf.observe(camera(k)).accepted
        if k % 20 == 0 and k > 100:
            position = TRUTH.T_map_body[k][:3, 3] + shift
            seen = PositionObservation(int(TRUTH.stamps_ns[k]), 'gps', position, 0.25 * np.eye(3))
            assert not ekf.observe(seen).accepted
    assert off_truth(ekf, 1000) < 0.1


def test_a_slow_input_alone_recovers_in_time() -> None:
    """One fix a second: three that agree, and seconds since the last accepted one, are enough."""
    ekf = started()
    shift = np.array([30.0, 0.0, 0.0])
    accepted = []
    for k in range(1, 1101):
        feed(ekf, k - 1, k)
        if k % 100 == 0:
            position = TRUTH.T_map_body[k][:3, 3] + (shift if k > 200 else 0.0)
            seen = PositionObservation(int(TRUTH.stamps_ns[k]), 'gps', position, 0.25 * np.eye(3))
            accepted.append(ekf.observe(seen).accepted)
    assert accepted[:2] == [True, True] and accepted[2] is False
    assert accepted[6:] == [True] * 5


def test_a_full_pose_pulls_it_back_from_anywhere_in_one_step() -> None:
    """A pose that is told with certainty: however far off, the step is exact."""
    ekf = VehicleEkf(EkfSettings(gate=GateConfig(probability=1.0)))
    ekf.start(0, se3.exp([60.0, -40.0, 5.0, 0.1, 0.2, 2.0]), np.diag([1e4] * 3 + [10.0] * 3))
    ekf.observe(PoseObservation(0, 'camera', TRUTH.T_map_body[0], 1e-6 * np.eye(6)))
    estimate = ekf.estimate()
    assert estimate is not None
    metres, radians = se3.distance(estimate.T_map_body, TRUTH.T_map_body[0])
    assert metres < 1e-4 and radians < 1e-5
