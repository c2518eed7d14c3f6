"""Inertial measurements are summed up as physics has it, and hold the graph's tilt."""

import gtsam
import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.imu_preintegration import ImuConfig, ImuPreintegration, ImuSample
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.pose_graph import PoseGraph

G = np.array([0.0, 0.0, 9.81])
RATE_HZ = 200
STEP_NS = 1_000_000_000 // RATE_HZ
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))
T_BASE_IMU = se3.exp([0.3, -0.1, 0.5, 0.0, 0.0, 1.0])


def motion_at(t: float) -> np.ndarray:
    """Return T_world_base of a smooth drive that rolls and pitches; at rest before t = 1 s."""
    s = max(t - 1.0, 0.0)
    ramp = s**3 / (1.0 + s**2)
    R = se3.so3_exp([0, 0, 0.2 * np.sin(0.5 * ramp)]) @ se3.so3_exp([0.05 * np.sin(ramp), 0, 0])
    start = se3.so3_exp([0.04, -0.03, 0])  # parked on a slope
    return se3.from_rotation_translation(R @ start, [2.0 * ramp, np.sin(0.6 * ramp), 0.1 * ramp])


def sample_at(t: float) -> ImuSample:
    """Return what a perfect sensor measures, by differences of the true motion."""
    h = 1e-4
    T = [motion_at(t + k * h) @ T_BASE_IMU for k in (-1, 0, 1)]
    acceleration = (T[0][:3, 3] - 2 * T[1][:3, 3] + T[2][:3, 3]) / h**2
    R = T[1][:3, :3]
    turn = se3.so3_log(T[0][:3, :3].T @ T[2][:3, :3]) / (2 * h)
    return ImuSample(round(t * 1e9), turn, R.T @ (acceleration + G))


def fill(take, start_s: float, end_s: float) -> None:
    for k in range(round(start_s * RATE_HZ), round(end_s * RATE_HZ)):
        # Measured in the middle of the interval in which it holds.
        middle = sample_at((k + 0.5) / RATE_HZ)
        take(ImuSample(k * STEP_NS, middle.angular_velocity, middle.linear_acceleration))


def test_the_sum_predicts_the_true_motion() -> None:
    sums = ImuPreintegration(ImuConfig(), T_BASE_IMU)
    fill(sums.add, 2.0, 4.0)
    total = sums.between(2_503_000_000, 3_502_000_000, gtsam.imuBias.ConstantBias())
    assert total is not None and total.deltaTij() == pytest.approx(0.999)
    h = 1e-4
    start, end = motion_at(2.503), motion_at(3.502)
    velocity = (motion_at(2.503 + h) - motion_at(2.503 - h))[:3, 3] / (2 * h)
    state = gtsam.NavState(gtsam.Pose3(start), velocity)
    predicted = total.predict(state, gtsam.imuBias.ConstantBias()).pose().matrix()
    metres, radians = se3.distance(end, predicted)
    assert metres < 0.02 and radians < 2e-3


def test_gaps_and_bad_samples_are_noticed() -> None:
    sums = ImuPreintegration(ImuConfig(), T_BASE_IMU)
    fill(sums.add, 0.0, 1.0)
    fill(sums.add, 1.5, 2.0)
    bias = gtsam.imuBias.ConstantBias()
    assert sums.between(100_000_000, 900_000_000, bias) is not None
    assert sums.between(900_000_000, 1_600_000_000, bias) is None  # a gap inside
    assert sums.between(1_900_000_000, 2_500_000_000, bias) is None  # no samples at the end
    good = sample_at(3.0)
    assert not sums.add(ImuSample(0, good.angular_velocity, good.linear_acceleration))
    assert not sums.add(ImuSample(2**62, good.angular_velocity * np.nan, G))


def test_a_parked_vehicle_is_levelled() -> None:
    sums = ImuPreintegration(ImuConfig(), T_BASE_IMU)
    assert sums.level(0) is None
    fill(sums.add, 0.0, 0.9)
    level = sums.level(800_000_000)
    assert level is not None
    up = np.array([0, 0, 1.0])
    np.testing.assert_allclose(level[:3, :3].T @ up, motion_at(0.5)[:3, :3].T @ up, atol=1e-3)
    assert se3.yaw(level) == pytest.approx(0.0, abs=1e-9)


def test_gravity_holds_the_tilt_that_odometry_loses() -> None:
    """Odometry that rolls by 0.3 degrees a keyframe; the inertial factors know better."""
    graph, bent = PoseGraph(), PoseGraph()
    graph.use_imu(ImuConfig(), T_BASE_IMU)
    previous_s = 0.0
    for k in range(40):
        t = 0.8 + 0.2 * k
        fill(graph.add_imu, previous_s, t)
        previous_s = t
        T_previous_this = np.eye(4)
        if k:
            T_previous_this = se3.inverse(motion_at(t - 0.2)) @ motion_at(t)
            T_previous_this = T_previous_this @ se3.exp([0, 0, 0, np.radians(0.3), 0, 0])
        keyframe = Keyframe(
            k, round(t * 1e9), np.eye(4), T_previous_this, diagonal(0.02, 6e-3), NO_POINTS
        )
        for each in (graph, bent):
            each.add_keyframe(keyframe)
            each.update()
    end = motion_at(0.8 + 0.2 * 39)
    up = np.array([0.0, 0.0, 1.0])

    def tilt_error(T: np.ndarray) -> float:
        return float(np.arccos(np.clip((T[:3, :3].T @ up) @ (end[:3, :3].T @ up), -1, 1)))

    assert tilt_error(bent.poses()[-1]) > np.radians(8.0)
    assert tilt_error(graph.poses()[-1]) < np.radians(1.0)
    with pytest.raises(ConfigError, match='before the first keyframe'):
        graph.use_imu(ImuConfig(), T_BASE_IMU)
    assert not bent.add_imu(sample_at(20.0))
