"""Motion and covariance between keyframes, against the errors that odometry really made."""

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.keyframe_builder import KeyframeBuilder

CLOUD = PointCloud(np.ones((3, 3), np.float32))
STEP = np.diag([1e-4, 4e-4, 2e-4, 1e-6, 2e-6, 4e-6])


def _drive(steps: int) -> list[StampedPose]:
    T, covariance = np.eye(4), 1e-9 * np.eye(6)
    poses = [StampedPose(0, T, covariance)]
    for k in range(1, steps):
        motion = se3.exp([1.0, 0.1, 0.0, 0.0, 0.01, 0.2])
        T = T @ motion
        covariance = se3.compose_covariance(covariance, motion, STEP)
        poses.append(StampedPose(k * 100, T, covariance))
    return poses


def test_the_motion_since_the_last_keyframe_has_the_covariance_it_added() -> None:
    poses = _drive(60)
    builder = KeyframeBuilder()
    keyframes = [builder.build(poses[k], CLOUD, None, '') for k in (0, 10, 55)]
    assert [k.id for k in keyframes] == [0, 1, 2]
    np.testing.assert_array_equal(keyframes[0].T_previous_this, np.eye(4))
    assert keyframes[0].motion_covariance is None
    for last, this in ((0, 10), (10, 55)):
        expected, T = np.zeros((6, 6)), np.eye(4)
        for _ in range(this - last):
            motion = se3.exp([1.0, 0.1, 0.0, 0.0, 0.01, 0.2])
            T, expected = T @ motion, se3.compose_covariance(expected, motion, STEP)
        keyframe = keyframes[1 if last == 0 else 2]
        np.testing.assert_allclose(keyframe.T_previous_this, T, atol=1e-9)
        assert keyframe.motion_covariance is not None
        np.testing.assert_allclose(keyframe.motion_covariance, expected, rtol=1e-6, atol=1e-12)


def test_a_covariance_that_does_not_accumulate_says_nothing() -> None:
    for covariance in (None, np.zeros((6, 6)), np.diag([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])):
        builder = KeyframeBuilder()
        for pose in _drive(3):
            keyframe = builder.build(
                StampedPose(pose.stamp_ns, pose.T_odom_base, covariance), CLOUD, None, ''
            )
            assert keyframe.motion_covariance is None


def test_numbering_goes_on_from_a_loaded_map() -> None:
    builder = KeyframeBuilder(41)
    assert [builder.build(p, CLOUD, None, '').id for p in _drive(3)] == [41, 42, 43]
