"""Turn the messages of a bag into records; any object with a message's attributes will do."""

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

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
from bags.skips import UnreadableError
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.point_fields import cloud_from_fields

_NO_FIX = -1
# Channels of the encodings read here, and their order as RGB; bgr is turned round.
_CHANNELS: dict[str, tuple[int, tuple[int, ...]]] = {
    'mono8': (1, (0,)),
    '8UC1': (1, (0,)),
    'rgb8': (3, (0, 1, 2)),
    'bgr8': (3, (2, 1, 0)),
    '8UC3': (3, (2, 1, 0)),
    'rgba8': (4, (0, 1, 2)),
    'bgra8': (4, (2, 1, 0)),
}


def stamp_of(message: Any) -> int:
    """Return the header's stamp in nanoseconds; zero means "not set": UnreadableError."""
    stamp = message.header.stamp
    nanoseconds = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if nanoseconds <= 0:
        raise UnreadableError(
            'message without a stamp', 'the header stamp is zero, which means "not set"'
        )
    return nanoseconds


def scan_from(message: Any) -> LidarScan:
    """Read a PointCloud2."""
    stamp = stamp_of(message)
    try:
        cloud = cloud_from_fields(message, stamp)
    except DataError as error:
        raise UnreadableError('point cloud with a wrong layout', str(error)) from None
    return LidarScan(stamp, cloud, _frame(message) or 'lidar')


def image_from(message: Any) -> CameraImage:
    """Read an Image or a CompressedImage."""
    pixels = _unpack_image(message) if hasattr(message, 'format') else _raw_image(message)
    return CameraImage(stamp_of(message), pixels, _frame(message) or 'camera')


def imu_from(message: Any) -> ImuSample:
    """Read an Imu; one that says it has no rates or accelerations raises UnreadableError."""
    for name in ('angular_velocity', 'linear_acceleration'):
        if float(getattr(message, f'{name}_covariance')[0]) == -1.0:
            raise UnreadableError(f'Imu without {name}', f'the driver says that it has no {name}')
    rate, acceleration = _vector(message.angular_velocity), _vector(message.linear_acceleration)
    _must_be_finite('Imu', rate, acceleration)
    return ImuSample(stamp_of(message), rate, acceleration, _frame(message) or 'imu')


def fix_from(message: Any) -> GnssFix:
    """Read a NavSatFix; one without a fix raises UnreadableError."""
    values = np.array([message.latitude, message.longitude, message.altitude], np.float64)
    if message.status.status == _NO_FIX:
        raise UnreadableError('GNSS without a fix', 'the receiver had no fix')
    _must_be_finite('NavSatFix', values)
    covariance = None
    if message.position_covariance_type != 0:
        covariance = np.array(message.position_covariance, np.float64).reshape(3, 3)
        _must_be_finite('covariance of NavSatFix', covariance)
    latitude, longitude, altitude = (float(v) for v in values)
    frame = _frame(message) or 'gps'
    return GnssFix(stamp_of(message), latitude, longitude, altitude, covariance, frame)


def twist_from(message: Any) -> TwistSample:
    """Read a TwistStamped, a TwistWithCovarianceStamped or the twist of an Odometry."""
    twist, covariance = message.twist, None
    if hasattr(twist, 'twist'):
        covariance = np.array(twist.covariance, np.float64).reshape(6, 6)
        covariance = covariance if covariance.any() else None
        twist = twist.twist
    frame = getattr(message, 'child_frame_id', '').lstrip('/') or _frame(message) or 'base_link'
    linear, angular = _vector(twist.linear), _vector(twist.angular)
    _must_be_finite('twist', linear, angular)
    return TwistSample(stamp_of(message), linear, angular, covariance, frame)


def truth_from(message: Any) -> TruthPose:
    """Read a PoseStamped, a PoseWithCovarianceStamped, an Odometry or a TransformStamped."""
    pose = getattr(message, 'pose', None)
    if pose is None:
        transform = message.transform
        return TruthPose(stamp_of(message), _transform(transform.translation, transform.rotation))
    pose = getattr(pose, 'pose', pose)
    return TruthPose(stamp_of(message), _transform(pose.position, pose.orientation))


def camera_from(message: Any) -> CameraModel:
    """Read a CameraInfo; a distortion model other than plumb_bob raises UnreadableError."""
    names = [name for name in ('k', 'K') if hasattr(message, name)]  # ROS 1 spells it K
    K = np.array(getattr(message, names[0]), np.float64).reshape(3, 3)
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise UnreadableError('CameraInfo without calibration', 'CameraInfo has no focal length')
    distortion = [float(v) for v in (message.d if hasattr(message, 'd') else message.D)]
    if any(distortion) and (message.distortion_model != 'plumb_bob' or len(distortion) > 5):
        raise UnreadableError(
            'CameraInfo of another distortion model',
            f'expected plumb_bob, got {message.distortion_model}; rectify the images first',
        )
    k1, k2, p1, p2, k3 = (distortion + [0.0] * 5)[:5]
    frame = _frame(message) or 'camera'
    return CameraModel(frame, int(message.width), int(message.height), K, (k1, k2, p1, p2, k3))


def mountings_from(message: Any) -> list[Mounting]:
    """Read a TFMessage; a broken transform raises UnreadableError."""
    return [
        Mounting(
            stamped.header.frame_id.lstrip('/'),
            stamped.child_frame_id.lstrip('/'),
            _transform(stamped.transform.translation, stamped.transform.rotation),
        )
        for stamped in message.transforms
    ]


# What each role of a topic becomes, and how.
KINDS: dict[str, type[Record]] = {
    'points': LidarScan,
    'image': CameraImage,
    'imu': ImuSample,
    'gnss': GnssFix,
    'twist': TwistSample,
    'truth': TruthPose,
}
CONVERTERS: dict[str, Callable[[Any], Any]] = {
    'points': scan_from,
    'image': image_from,
    'imu': imu_from,
    'gnss': fix_from,
    'twist': twist_from,
    'truth': truth_from,
}


def _frame(message: Any) -> str:
    return str(message.header.frame_id).lstrip('/')


def _vector(message: Any) -> NDArray[np.float64]:
    return np.array([message.x, message.y, message.z], np.float64)


def _must_be_finite(what: str, *values: NDArray[np.float64]) -> None:
    if not all(np.isfinite(v).all() for v in values):
        raise UnreadableError(
            f'{what} that is not finite', f'{what} holds a NaN or an infinite number'
        )


def _transform(translation: Any, rotation: Any) -> se3.Array:
    xyz = _vector(translation)
    _must_be_finite('pose', xyz)
    try:
        return se3.from_xyz_quaternion(xyz, [rotation.x, rotation.y, rotation.z, rotation.w])
    except ValueError as error:
        raise UnreadableError('pose that is not finite', str(error)) from None


def _raw_image(message: Any) -> NDArray[np.uint8]:
    if message.encoding not in _CHANNELS:
        raise UnreadableError(
            f'image encoding {message.encoding}',
            f'the encoding must be one of {", ".join(_CHANNELS)}, got {message.encoding}',
        )
    channels, order = _CHANNELS[message.encoding]
    data = np.frombuffer(message.data, np.uint8)
    used = message.width * channels
    if message.step < used or len(data) < message.height * message.step or not len(data):
        raise UnreadableError(
            'unreadable image',
            f'{message.width} x {message.height} {message.encoding} with step {message.step} needs '
            f'{message.height * message.step} bytes, got {len(data)}',
        )
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, :used]
    if channels == 1:
        return np.ascontiguousarray(rows)
    pixels = rows.reshape(message.height, message.width, channels)
    return np.ascontiguousarray(pixels[:, :, list(order)])


def _unpack_image(message: Any) -> NDArray[np.uint8]:
    try:
        with Image.open(io.BytesIO(bytes(message.data))) as image:
            pixels = image if image.mode in ('L', 'RGB') else image.convert('RGB')
            return np.asarray(pixels, dtype=np.uint8)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise UnreadableError('unreadable image', f'not a readable image: {error}') from None
