"""What goes wrong on vehicles: the ekf node drops it, counts it, says it and goes on."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticStatus
from ekf_bench import QUIET, Bench, camera, imu, stamp
from geometry_msgs.msg import Vector3

from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common.errors import ConfigError
from lcd_common.nodes import messages

pytestmark = pytest.mark.ros
Make = Callable[..., Any]


@pytest.fixture
def bench(make: Make) -> Callable[..., Bench]:
    def construct(namespace: str = '', **parameters: object) -> Bench:
        values = {**QUIET, 'publish_rate': 10.0, **parameters}
        return Bench(make(EkfNode, namespace=namespace or None, **values), namespace)

    return construct


def test_what_is_broken_is_dropped_and_counted(bench: Callable[..., Bench]) -> None:
    running = bench(publish_rate=0.0)
    running.drive(0, 101)
    node, k = running.node, 101
    nan = float('nan')
    bad = imu(k)
    bad.angular_velocity.x = nan
    running.feed('imu', bad)
    unknown = imu(k)
    unknown.angular_velocity_covariance[0] = -1.0
    running.feed('imu', unknown)
    running.feed('imu', imu(100))
    assert node.diagnostics.counted('rejected imu: unusable') == 3
    running.feed('imu', imu(k, header=messages.header(stamp(k), 'elsewhere')))
    assert node.diagnostics.counted('rejected imu: no transform') == 1
    running.feed('imu', imu(k))
    assert 'does not connect' not in running.problems()[1]  # it came right again

    running.feed('camera_pose', camera(k, frame='odom'))
    assert node.diagnostics.counted('rejected camera: wrong frame') == 1
    for place, value in ((0, nan), (0, -1.0), (1, 5.0)):
        message = camera(k)
        message.pose.covariance[place] = value
        running.feed('camera_pose', message)
    zero = camera(k)
    zero.pose.covariance = np.zeros(36)
    running.feed('camera_pose', zero)
    broken = camera(k)
    broken.pose.pose.position.x = nan
    running.feed('camera_pose', broken)
    turned = camera(k)
    turned.pose.pose.orientation.w = turned.pose.pose.orientation.z = 0.0
    turned.pose.pose.orientation.x = turned.pose.pose.orientation.y = 0.0
    running.feed('camera_pose', turned)
    assert node.diagnostics.counted('rejected camera: unusable') == 6
    assert running.off(k) < 0.1


def test_wrong_poses_are_said_and_survived(bench: Callable[..., Bench]) -> None:
    running = bench()
    running.drive(0, 201)
    rng = np.random.default_rng(0)
    for k in range(201, 301):
        running.feed('imu', imu(k))
        lie = np.array([*rng.normal(size=2) * 3 + 15, 0.0])
        running.feed('camera_pose', camera(k, off=lie * rng.choice([-1, 1], 3)))
    level, text = running.problems()
    assert level == DiagnosticStatus.WARN and 'camera was rejected 100 times in a row' in text
    running.drive(301, 501)
    assert running.off(500) < 0.1
    assert running.problems()[0] == DiagnosticStatus.OK


def test_without_a_camera_it_goes_on_and_becomes_unsure(bench: Callable[..., Bench]) -> None:
    running = bench(health__position_warn=0.25, health__position_error=0.6)
    running.drive(0, 201)
    running.drive(201, 501, camera_every=0)
    level, text = running.problems()
    assert 'camera has been silent' in text and 'only known to' in text
    assert level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    assert running.off(500) < 1.0
    running.drive(501, 601)
    assert running.off(600) < 0.1
    assert running.problems()[0] == DiagnosticStatus.OK


@pytest.mark.parametrize('policy', ['restart', 'keep'])
def test_a_clock_that_jumps_back_is_survived(bench: Callable[..., Bench], policy: str) -> None:
    running = bench(on_time_jump=policy)
    running.drive(500, 701)
    running.odometry.clear()
    running.feed('imu', imu(0))
    running.feed('camera_pose', camera(0))
    running.drive(1, 301)
    assert running.node.diagnostics.counted('clock jumps') == 1
    assert running.off(300) < 0.1


def test_a_frozen_imu_is_an_error_and_a_guess(bench: Callable[..., Bench]) -> None:
    running = bench(frozen_imu=10)
    rng = np.random.default_rng(0)
    for k in range(400):
        message = imu(k)
        message.linear_acceleration.x += rng.normal() * 0.01
        if 200 <= k < 300:  # the last value again and again, upwards
            message.linear_acceleration = Vector3(x=0.0, y=0.0, z=13.0)
            message.angular_velocity = Vector3()
        running.feed('imu', message)
        if k % 10 == 0 and not 200 <= k < 300:
            running.feed('camera_pose', camera(k))
        if k == 250:
            level, text = running.problems()
            assert level == DiagnosticStatus.ERROR and 'frozen' in text
    assert running.node.diagnostics.counted('camera rejected: outlier') == 0
    running.feed('imu', imu(400))
    assert running.off(400) < 0.3


@pytest.mark.parametrize(
    ('wrong', 'text'),
    [
        ({'camera__axes': 'x y heading'}, 'must name some of x y z'),
        ({'camera__axes': ''}, 'must name some'),
        ({'poses': 'gps', 'fixes': 'gps'}, 'a name of its own'),
        ({'motion__gravity': -1.0}, 'gravity'),
        ({'tf': 'odom'}, 'tf'),
    ],
)
def test_wrong_parameters_are_said(make: Make, wrong: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        make(EkfNode, **wrong)


def test_one_message_from_the_future_does_no_harm(bench: Callable[..., Bench]) -> None:
    running = bench()
    running.drive(0, 101)
    future = camera(100)
    future.header.stamp.sec += 100
    running.feed('camera_pose', future)
    assert running.node.diagnostics.counted('rejected camera: ahead of imu') == 1
    running.drive(101, 201)
    assert running.off(200) < 0.1
    assert running.node.diagnostics.counted('rejected imu: unusable') == 0
