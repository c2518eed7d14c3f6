"""Conversions: struct is the second reader, serialisation the second opinion."""

import struct

import numpy as np
import pytest
from geometry_msgs.msg import Pose, PoseWithCovariance
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.nodes import messages

pytestmark = pytest.mark.ros
STAMP = 1_700_000_000_123_456_789
RNG = np.random.default_rng(0)


def test_clouds_survive_the_wire() -> None:
    cloud = PointCloud(
        RNG.normal(size=(100, 3)).astype(np.float32),
        RNG.uniform(size=100).astype(np.float32),
        np.linspace(0, 0.1, 100, dtype=np.float32),
    )
    message = messages.cloud_message(cloud, STAMP, 'lidar')
    message = deserialize_message(serialize_message(message), PointCloud2)
    assert messages.stamp_ns(message.header.stamp) == STAMP and message.header.frame_id == 'lidar'
    assert [(f.name, f.offset) for f in message.fields] == [
        ('x', 0), ('y', 4), ('z', 8), ('intensity', 12), ('time', 16)
    ]  # fmt: skip
    peer = np.array(list(struct.iter_unpack('<5f', bytes(message.data))), np.float32)
    np.testing.assert_array_equal(peer[:, :3], cloud.xyz)
    back = messages.cloud_from_message(message)
    np.testing.assert_array_equal(back.xyz, cloud.xyz)
    np.testing.assert_array_equal(back.intensity, cloud.intensity)
    np.testing.assert_allclose(back.time_s, cloud.time_s, atol=1e-7)
    empty = messages.cloud_message(PointCloud(np.empty((0, 3), np.float32)), STAMP, 'lidar')
    assert len(messages.cloud_from_message(empty)) == 0


def test_poses_and_covariances_come_back() -> None:
    T = se3.exp(RNG.normal(size=6))
    A = RNG.normal(size=(6, 6))
    covariance = A @ A.T + np.eye(6)
    message = messages.pose_with_covariance(T, covariance)
    # ROS wants the parent's axes: this is what a consumer sees of a rotated body's covariance.
    R = T[:3, :3]
    np.testing.assert_allclose(
        np.asarray(message.covariance).reshape(6, 6)[:3, :3], R @ covariance[:3, :3] @ R.T
    )
    T_back, covariance_back = messages.from_pose_with_covariance(message)
    np.testing.assert_allclose(T_back, T, atol=1e-12)
    np.testing.assert_allclose(covariance_back, covariance, atol=1e-10)
    np.testing.assert_allclose(
        messages.transform_from_message(messages.transform_message(T)), T, atol=1e-12
    )


def test_an_unknown_covariance_is_none_and_a_broken_one_refused() -> None:
    message = messages.pose_with_covariance(np.eye(4), None)
    assert messages.from_pose_with_covariance(message)[1] is None
    for broken in (np.nan * np.eye(6), -np.eye(6), np.diag([1.0, 1, 1, 1, 1, 0])):
        message = PoseWithCovariance(pose=messages.pose_message(np.eye(4)))
        message.covariance = broken.ravel()
        with pytest.raises(DataError, match='positive definite'):
            messages.from_pose_with_covariance(message)


def test_poses_that_are_none_are_refused() -> None:
    with pytest.raises(DataError, match='quaternion must have a length'):
        messages.transform_from_pose(_no_rotation())
    pose = messages.pose_message(np.eye(4))
    pose.position.x = float('nan')
    with pytest.raises(DataError, match='must be finite'):
        messages.transform_from_pose(pose)


def _no_rotation() -> Pose:
    pose = Pose()
    pose.orientation.w = 0.0
    return pose
