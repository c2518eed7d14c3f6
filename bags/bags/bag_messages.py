"""Turn records into serialized ROS 2 messages (CDR), without ROS.

Bags store these bytes, `bags play` publishes them, and lock-step replay hands nodes what they
decode to: all three give a node the same message.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from bags.records import (
    CameraImage,
    CameraModel,
    GnssFix,
    ImuSample,
    LidarScan,
    Mounting,
    Record,
    TruthPose,
    TwistSample,
)
from bags.topics import CAMERA_INFO_TOPIC, TF_STATIC_TOPIC, TOPICS
from lcd_common import se3
from lcd_common.point_fields import layout

TYPES = get_typestore(Stores.ROS2_JAZZY)
_T: dict[str, Any] = dict(TYPES.types)
_UNKNOWN = np.zeros(9)
# REP-145: an Imu says with -1 that it has no orientation; zeros elsewhere are "covariance unknown".
_NO_ORIENTATION = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])
_WORLD_FRAME = 'world'


@dataclass(frozen=True)
class BagBytes:
    """One serialized message on its topic, with its header stamp."""

    topic: str
    type_name: str
    stamp_ns: int
    data: bytes


def encode(record: Record, camera: CameraModel | None = None) -> Iterator[BagBytes]:
    """Yield the message of a record; before an image of `camera` comes its CameraInfo."""
    topic, type_name = TOPICS[type(record)]
    if isinstance(record, CameraImage) and camera and record.frame_id == camera.frame_id:
        yield camera_info(camera, record.stamp_ns)
    yield _bytes(topic, type_name, record.stamp_ns, _MAKERS[type(record)](record))


def static_transforms(mountings: Sequence[Mounting], stamp_ns: int) -> BagBytes:
    """Return all mountings as one /tf_static message."""
    stamped = [
        _new(
            'geometry_msgs/msg/TransformStamped',
            header=_header(stamp_ns, mounting.parent),
            child_frame_id=mounting.child,
            transform=_new(
                'geometry_msgs/msg/Transform',
                translation=_vector(mounting.T_parent_child[:3, 3]),
                rotation=_quaternion(mounting.T_parent_child),
            ),
        )
        for mounting in mountings
    ]
    message = _new('tf2_msgs/msg/TFMessage', transforms=stamped)
    return _bytes(TF_STATIC_TOPIC, 'tf2_msgs/msg/TFMessage', stamp_ns, message)


def camera_info(camera: CameraModel, stamp_ns: int) -> BagBytes:
    """Return the CameraInfo of one image."""
    message = _new(
        'sensor_msgs/msg/CameraInfo',
        header=_header(stamp_ns, camera.frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model='plumb_bob',
        d=np.array(camera.distortion, np.float64),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=_new(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )
    return _bytes(CAMERA_INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', stamp_ns, message)


def _cloud(scan: LidarScan) -> Any:
    points, fields = layout(scan.cloud)
    data = np.ascontiguousarray(points).view(np.uint8).reshape(-1)
    return _new(
        'sensor_msgs/msg/PointCloud2',
        header=_header(scan.stamp_ns, scan.frame_id),
        height=1,
        width=len(points),
        fields=[
            _new('sensor_msgs/msg/PointField', name=n, offset=o, datatype=t, count=1)
            for n, o, t in fields
        ],
        is_bigendian=False,
        point_step=points.dtype.itemsize,
        row_step=len(data),
        data=data,
        is_dense=bool(np.isfinite(scan.cloud.xyz).all()),
    )


def _image(image: CameraImage) -> Any:
    height, width = image.pixels.shape[:2]
    data = np.ascontiguousarray(image.pixels).reshape(-1)
    return _new(
        'sensor_msgs/msg/Image',
        header=_header(image.stamp_ns, image.frame_id),
        height=height,
        width=width,
        encoding='mono8' if image.pixels.ndim == 2 else 'rgb8',
        is_bigendian=0,
        step=len(data) // height,
        data=data,
    )


def _imu(sample: ImuSample) -> Any:
    return _new(
        'sensor_msgs/msg/Imu',
        header=_header(sample.stamp_ns, sample.frame_id),
        orientation=_quaternion(np.eye(4)),
        orientation_covariance=_NO_ORIENTATION,
        angular_velocity=_vector(sample.angular_velocity),
        angular_velocity_covariance=_UNKNOWN,
        linear_acceleration=_vector(sample.linear_acceleration),
        linear_acceleration_covariance=_UNKNOWN,
    )


def _fix(fix: GnssFix) -> Any:
    known = fix.covariance_enu is not None
    status = _T['sensor_msgs/msg/NavSatStatus']
    kinds = _T['sensor_msgs/msg/NavSatFix']
    return _new(
        'sensor_msgs/msg/NavSatFix',
        header=_header(fix.stamp_ns, fix.frame_id),
        status=_new(
            'sensor_msgs/msg/NavSatStatus', status=status.STATUS_FIX, service=status.SERVICE_GPS
        ),
        latitude=fix.latitude_deg,
        longitude=fix.longitude_deg,
        altitude=fix.altitude_m,
        position_covariance=_UNKNOWN
        if fix.covariance_enu is None
        else np.asarray(fix.covariance_enu, np.float64).ravel(),
        position_covariance_type=(
            kinds.COVARIANCE_TYPE_KNOWN if known else kinds.COVARIANCE_TYPE_UNKNOWN
        ),
    )


def _twist(sample: TwistSample) -> Any:
    return _new(
        'geometry_msgs/msg/TwistStamped',
        header=_header(sample.stamp_ns, sample.frame_id),
        twist=_new(
            'geometry_msgs/msg/Twist',
            linear=_vector(sample.linear),
            angular=_vector(sample.angular),
        ),
    )


def _pose(truth: TruthPose) -> Any:
    x, y, z = (float(v) for v in truth.T_world_base[:3, 3])
    return _new(
        'geometry_msgs/msg/PoseStamped',
        header=_header(truth.stamp_ns, _WORLD_FRAME),
        pose=_new(
            'geometry_msgs/msg/Pose',
            position=_new('geometry_msgs/msg/Point', x=x, y=y, z=z),
            orientation=_quaternion(truth.T_world_base),
        ),
    )


_MAKERS: dict[type[Record], Any] = {
    LidarScan: _cloud,
    CameraImage: _image,
    ImuSample: _imu,
    GnssFix: _fix,
    TwistSample: _twist,
    TruthPose: _pose,
}


def _new(type_name: str, **fields: Any) -> Any:
    return _T[type_name](**fields)


def _bytes(topic: str, type_name: str, stamp_ns: int, message: Any) -> BagBytes:
    return BagBytes(topic, type_name, stamp_ns, bytes(TYPES.serialize_cdr(message, type_name)))


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    stamp = _new('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return _new('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def _vector(v: se3.Array) -> Any:
    return _new('geometry_msgs/msg/Vector3', x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _quaternion(T: se3.Array) -> Any:
    x, y, z, w = (float(v) for v in se3.quaternion_from_rotation(T[:3, :3]))
    return _new('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)
