"""Convert between messages and the types of the cores."""

import array

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseWithCovariance, Transform
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.point_fields import cloud_from_fields, layout


def stamp_ns(time: Time) -> int:
    """Return a message stamp in nanoseconds."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def time_message(stamp: int) -> Time:
    """Return nanoseconds as a message stamp."""
    seconds, nanoseconds = divmod(int(stamp), 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header(stamp: int, frame_id: str) -> Header:
    """Make a header from nanoseconds and a frame."""
    return Header(stamp=time_message(stamp), frame_id=frame_id)


def cloud_from_message(message: PointCloud2) -> PointCloud:
    """Read a PointCloud2; raises DataError when it has no x, y and z or an impossible layout."""
    return cloud_from_fields(message, stamp_ns(message.header.stamp))


def cloud_message(cloud: PointCloud, stamp: int, frame_id: str) -> PointCloud2:
    """Make a PointCloud2 with x y z, and intensity and time where known."""
    points, fields = layout(cloud)
    return points_message(points, fields, stamp, frame_id)


def points_message(
    points: NDArray[np.void], fields: list[tuple[str, int, int]], stamp: int, frame_id: str
) -> PointCloud2:
    """Make a PointCloud2 from a structured array [N] and its (name, offset, datatype) fields."""
    # An array('B') is taken over as it is; assigning bytes would be checked byte by byte.
    data = array.array('B')
    data.frombytes(np.ascontiguousarray(points).view(np.uint8).data)
    return PointCloud2(
        header=header(stamp, frame_id),
        height=1,
        width=len(points),
        fields=[PointField(name=n, offset=o, datatype=t, count=1) for n, o, t in fields],
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=points.dtype.itemsize * len(points),
        data=data,
        is_dense=True,
    )


def pose_message(T: se3.Array) -> Pose:
    """Make a Pose from a 4x4 transform."""
    pose = Pose()
    pose.position.x, pose.position.y, pose.position.z = (float(v) for v in T[:3, 3])
    x, y, z, w = se3.quaternion_from_rotation(T[:3, :3])
    pose.orientation.x, pose.orientation.y = float(x), float(y)
    pose.orientation.z, pose.orientation.w = float(z), float(w)
    return pose


def transform_from_pose(pose: Pose) -> se3.Array:
    """Read a Pose; raises DataError when it is not finite or its quaternion has no length."""
    p, q = pose.position, pose.orientation
    return _transform([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def transform_message(T: se3.Array) -> Transform:
    """Make a geometry_msgs/Transform from a 4x4 transform."""
    pose = pose_message(T)
    message = Transform(rotation=pose.orientation)
    message.translation.x, message.translation.y = pose.position.x, pose.position.y
    message.translation.z = pose.position.z
    return message


def transform_from_message(message: Transform) -> se3.Array:
    """Read a geometry_msgs/Transform; raises DataError as `transform_from_pose` does."""
    t, q = message.translation, message.rotation
    return _transform([t.x, t.y, t.z], [q.x, q.y, q.z, q.w])


def pose_with_covariance(T: se3.Array, covariance_body: se3.Array | None) -> PoseWithCovariance:
    """Make a PoseWithCovariance; None (unknown) becomes zeros, as ROS has it."""
    message = PoseWithCovariance(pose=pose_message(T))
    if covariance_body is not None:
        message.covariance = se3.ros_covariance(T, covariance_body).ravel()
    return message


def from_pose_with_covariance(message: PoseWithCovariance) -> tuple[se3.Array, se3.Array | None]:
    """Read pose and body-axes covariance; an all-zero covariance is unknown: None.

    Raises:
        DataError: the pose is not finite, or the covariance is not positive definite.
    """
    T = transform_from_pose(message.pose)
    covariance = np.asarray(message.covariance, dtype=np.float64).reshape(6, 6)
    if not covariance.any():
        return T, None
    if not se3.is_covariance(covariance):
        raise DataError(
            'a pose covariance must be finite, symmetric and positive definite (or all zero when '
            f'unknown), got the diagonal {np.diag(covariance)}'
        )
    return T, se3.covariance_from_ros(T, covariance)


def _transform(xyz: list[float], quaternion: list[float]) -> se3.Array:
    if not np.isfinite(xyz).all():
        raise DataError(f'a pose must be finite, got the position {xyz}')
    try:
        return se3.from_xyz_quaternion(xyz, quaternion)
    except ValueError as error:
        raise DataError(str(error)) from None
