"""Feed the ekf node a drive and read what it publishes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticStatus
from ekf_bench import QUIET, Bench, base_pose, camera, fix, imu, odom, stamp
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
)
from sensor_msgs.msg import NavSatStatus
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_loop_closure.gnss import GnssDatum
from lcd_msgs.srv import SetPose

pytestmark = pytest.mark.ros
Make = Callable[..., Any]


@pytest.fixture
def bench(make: Make) -> Callable[..., Bench]:
    def construct(namespace: str = '', **parameters: object) -> Bench:
        values = {**QUIET, 'publish_rate': 10.0, **parameters}
        return Bench(make(EkfNode, namespace=namespace or None, **values), namespace)

    return construct


def test_it_follows_a_drive_by_an_imu_that_is_mounted_askew(bench: Callable[..., Bench]) -> None:
    running = bench()
    running.drive(0, 401)
    assert running.off(400) < 0.1
    message = running.odometry[-1]
    assert (message.header.frame_id, message.child_frame_id) == ('map', 'base_link')
    truth = se3.inverse(base_pose(399)) @ base_pose(400)
    twist = message.twist.twist
    velocity = [twist.linear.x, twist.linear.y, twist.linear.z]
    np.testing.assert_allclose(velocity, se3.log(truth)[:3] * 100, atol=0.1)
    turn = [twist.angular.x, twist.angular.y, twist.angular.z]
    np.testing.assert_allclose(turn, se3.log(truth)[3:] * 100, atol=0.02)
    last = running.tf[-1]
    assert (last.header.frame_id, last.child_frame_id) == ('map', 'base_link')
    assert running.problems() == (DiagnosticStatus.OK, 'ok')


def test_covariances_go_out_in_the_axes_and_the_order_of_ros(bench: Callable[..., Bench]) -> None:
    """A camera that is sure of everything but its own x axis: ROS wants that in map axes."""
    running = bench(start__velocity=0.01)
    T = se3.rotation_z(np.pi / 2)
    sigmas = np.array([2.0, 0.1, 0.2, 0.01, 0.02, 0.03])
    start = PoseWithCovarianceStamped(
        header=messages.header(stamp(0), 'map'),
        pose=messages.pose_with_covariance(T, np.diag(sigmas**2)),
    )
    running.feed('imu', imu(0))
    running.feed('camera_pose', start)
    given = np.array(running.odometry[-1].pose.covariance).reshape(6, 6)
    # Its x axis points along the map's y, its y against the map's x.
    expected = np.array([0.1, 2.0, 0.2, 0.02, 0.01, 0.03]) ** 2
    np.testing.assert_allclose(np.diag(given), expected, rtol=1e-6)


def test_late_poses_count_at_their_stamps(bench: Callable[..., Bench]) -> None:
    running = bench()
    running.drive(0, 11)
    for k in range(11, 501):
        running.feed('imu', imu(k))
        if k % 10 == 0 and k > 60:
            running.feed('camera_pose', camera(k - 50))  # half a second, four metres late
    assert running.off(500) < 0.1
    assert running.node.diagnostics.counted('camera rejected: outlier') == 0


def test_namespaces_and_remaps_hold(bench: Callable[..., Bench]) -> None:
    running = bench(namespace='/robot')
    running.drive(0, 101)
    assert running.off(100) < 0.1


def test_a_first_pose_starts_it_and_only_a_full_one(bench: Callable[..., Bench]) -> None:
    running = bench(camera__axes='x y yaw')
    running.drive(0, 50)
    assert not running.odometry
    level, text = running.problems()
    assert level == DiagnosticStatus.WARN and 'waiting for a full pose' in text


def test_services_and_initialpose(bench: Callable[..., Bench]) -> None:
    running = bench(start_from='set_pose', publish_rate=0.0)
    node = running.node
    request = SetPose.Request(pose=camera(0))
    assert not node.on_set_pose(request, SetPose.Response()).success  # no imu yet
    running.drive(0, 50)
    assert not running.odometry
    request.pose.header.frame_id = 'odom'
    answer = node.on_set_pose(request, SetPose.Response())
    assert not answer.success and 'must be in map' in answer.message
    request.pose = camera(49)
    request.pose.pose.covariance[0] = -1.0
    answer = node.on_set_pose(request, SetPose.Response())
    assert not answer.success and 'negative variance' in answer.message
    request.pose = camera(49)
    request.pose.header.stamp.sec = 0  # as a click in a viewer without simulated time
    assert node.on_set_pose(request, SetPose.Response()).success
    running.drive(50, 101)
    assert running.off(100) < 0.3
    assert node.on_reset(Trigger.Request(), Trigger.Response()).success
    running.odometry.clear()
    running.drive(101, 120)
    assert not running.odometry
    running.feed('initialpose', camera(119))
    assert len(running.odometry) == 1

    node.on_enable(SetBool.Request(data=False), SetBool.Response())
    running.odometry.clear()
    running.drive(120, 150)
    assert not running.odometry
    assert 'disabled' in running.problems()[1]
    assert node.diagnostics.counted('ignored imu: disabled') == 30
    node.on_enable(SetBool.Request(data=True), SetBool.Response())
    running.drive(150, 152)
    running.feed('initialpose', camera(151))
    assert running.off(151) < 1e-6


def test_a_click_says_nothing_of_height_and_tilt(bench: Callable[..., Bench]) -> None:
    running = bench(
        start_from='set_pose', publish_rate=0.0, start__position=0.7, start__rotation=0.05
    )
    running.drive(0, 50)
    click = camera(49)
    covariance = np.zeros((6, 6))
    covariance[0, 0] = covariance[1, 1] = 0.25
    covariance[5, 5] = 0.0685
    click.pose.covariance = covariance.ravel()
    running.feed('initialpose', click)
    assert len(running.odometry) == 1
    found = np.reshape(running.odometry[-1].pose.covariance, (6, 6))
    expected = [0.25, 0.25, 0.49, 0.0025, 0.0025, 0.0685]
    np.testing.assert_allclose(np.diag(found), expected, rtol=0.02)


def test_it_owns_map_to_odom_and_uses_odometrys_motion(bench: Callable[..., Bench]) -> None:
    running = bench(
        odometry='odom', tf='map_to_odom', odom__sigma_position=0.02, odom__sigma_rotation=0.002
    )
    T_map_odom = se3.exp([5.0, -3.0, 0.5, 0.0, 0.0, 1.0])
    running.drive(0, 11)
    for k in range(11, 501):
        running.feed('imu', imu(k))
        if k % 10 == 0:
            running.feed('odom', odom(k, T_map_odom, None))
    assert running.node.diagnostics.counted('odom accepted') >= 45
    last = running.tf[-1]
    assert (last.header.frame_id, last.child_frame_id) == ('map', 'odom')
    T = messages.transform_from_message(last.transform)
    # Five seconds on, with nothing but motions: still where it began, within what these let it.
    assert se3.distance(T @ se3.inverse(T_map_odom) @ base_pose(500), base_pose(500))[0] < 0.5
    rival = TransformStamped(
        header=messages.header(stamp(500), 'map'),
        child_frame_id='odom',
        transform=messages.transform_message(np.eye(4)),
    )
    running.lockstep.feed('/tf', TFMessage(transforms=[rival]))
    level, text = running.problems()
    assert level == DiagnosticStatus.ERROR and 'another node publishes map -> odom' in text


def test_odometry_that_does_not_say_how_sure_it_is_asks_for_sigmas(
    bench: Callable[..., Bench],
) -> None:
    running = bench(odometry='odom')
    running.drive(0, 11)
    running.feed('odom', odom(5, np.eye(4), None))
    running.feed('odom', odom(10, np.eye(4), None))
    assert running.node.diagnostics.counted('rejected odom: covariance unknown') == 1
    grown = [odom(k, np.eye(4), (k + 1) * 1e-4 * np.eye(6)) for k in (6, 9)]
    for message in grown:
        running.feed('odom', message)


def test_twists_count_along_the_axes_that_are_named(bench: Callable[..., Bench]) -> None:
    running = bench(twists='wheels', wheels__topic='wheel_twist')
    running.drive(0, 101)
    message = TwistWithCovarianceStamped(header=messages.header(stamp(100), 'base_link'))
    velocity = se3.log(se3.inverse(base_pose(99)) @ base_pose(100)) * 100
    message.twist.twist.linear.x = velocity[0]
    message.twist.twist.linear.y = float('nan')  # not an axis that counts
    message.twist.covariance[0] = 0.01
    message.twist.covariance[7] = -1.0
    running.feed('wheel_twist', message)
    assert running.node.diagnostics.counted('wheels accepted') == 1


def test_satellites_alone_start_and_guide_it(bench: Callable[..., Bench]) -> None:
    running = bench(
        poses='', fixes='gps', start_from='gnss', datum__latitude=45.5, datum__longitude=9.2,
        datum__altitude=120.0, gps__minimum_sigma=0.5,
    )  # fmt: skip
    datum = GnssDatum(45.5, 9.2, 120.0)
    for k in range(1001):
        running.feed('imu', imu(k))
        if k % 20 == 0:
            running.feed('gps/fix', fix(k, datum))
    assert running.off(1000) < 0.5
    lost = fix(1000, datum)
    lost.status.status = NavSatStatus.STATUS_NO_FIX
    running.feed('gps/fix', lost)
    assert running.node.diagnostics.counted('rejected gps: unusable') == 1


def test_without_an_imu_it_coasts_from_pose_to_pose(bench: Callable[..., Bench]) -> None:
    running = bench(use_imu=False)
    for k in range(0, 501, 10):
        running.feed('camera_pose', camera(k))
    assert running.off(500) < 0.3
    running.feed('camera_pose', camera(0))
    running.feed('camera_pose', camera(10))
    assert running.node.diagnostics.counted('clock jumps') == 1
    assert running.off(10) < 0.3


def test_it_predicts_to_the_present_time(bench: Callable[..., Bench]) -> None:
    running = bench(predict_to_now=True, publish_rate=20.0)
    running.drive(0, 201)
    running.lockstep.set_time(stamp(210))  # a tenth of a second after the last sample
    assert running.off(210) < 0.1
    running.lockstep.set_time(stamp(700))
    last = messages.stamp_ns(running.odometry[-1].header.stamp)
    assert last == stamp(200) + 1_000_000_000  # no further than history.max_prediction
