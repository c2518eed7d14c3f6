"""Messages to bytes and back; equal messages give equal bytes."""

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import NavSatFix, PointCloud2
from std_msgs.msg import String

from bags.bag_messages import encode
from bags.nodes.ros_messages import decode, encode_repeatably, message_class
from bags.records import LidarScan
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.nodes import messages
from lcd_msgs.msg import Keyframe, LoopConstraint, LoopConstraintArray

pytestmark = pytest.mark.ros


def examples() -> list:
    cloud = PointCloud(np.ones((5, 3), np.float32), np.zeros(5, np.float32))
    points = messages.cloud_message(cloud, 5, 'lidar')
    loop = LoopConstraint(fitness=math.nan, reason='far', query_id=7)
    loop.transform.covariance = np.arange(36.0)
    status = DiagnosticStatus(level=b'\x02', name='n', values=[KeyValue(key='a', value='b')])
    return [
        PoseStamped(header=messages.header(5, 'lidar')),
        NavSatFix(latitude=1.0, position_covariance=np.arange(9.0)),
        points,
        DiagnosticArray(status=[status]),
        Keyframe(id=3, descriptor=[1.0, 2.0], cloud=points, descriptor_method='m'),
        LoopConstraintArray(loops=[loop, LoopConstraint()]),
        String(data='x'),
    ]


@pytest.mark.parametrize('message', examples(), ids=lambda m: type(m).__name__)
def test_bytes_are_repeatable_and_mean_the_message(message: object) -> None:
    data = encode_repeatably(message)
    assert repr(deserialize_message(data, type(message))) == repr(message)  # NaN equals NaN there
    ours, theirs = (
        np.frombuffer(data, np.uint8),
        np.frombuffer(serialize_message(message), np.uint8),
    )
    assert len(ours) <= len(theirs) < len(ours) + 4  # rclpy pads the end
    for _ in range(20):
        litter = [bytes([255]) * size for size in (64, 100, 200, 400, 800)]
        assert encode_repeatably(message) == data
        del litter
    different = np.flatnonzero(ours != theirs[: len(ours)])
    assert not ours[different].any()  # only what rclpy leaves undefined, here zero


def test_decode_gives_the_installed_class() -> None:
    cloud = PointCloud(np.arange(6, dtype=np.float32).reshape(2, 3))
    (message,) = encode(LidarScan(10**9, cloud))
    decoded = decode(message.data, message.type_name)
    assert isinstance(decoded, PointCloud2)
    assert decoded == messages.cloud_message(cloud, 10**9, 'lidar')


@pytest.mark.parametrize('name', ['no_such_msgs/msg/Thing', 'std_msgs/msg/NoSuchThing'])
def test_a_missing_type_is_told(name: str) -> None:
    with pytest.raises(DataError, match=f'{name} is not installed here'):
        message_class(name)
