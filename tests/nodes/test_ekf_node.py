"""Feed the ekf node a drive, and what goes wrong on vehicles, and read what it publishes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from benchmarks.ekf_drive import ReferenceDrive, reference_drive
from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.nodes import messages
from lcd_loop_closure.gnss import GnssDatum
from lcd_msgs.srv import SetPose

pytestmark = pytest.mark.ros
Make = Callable[..., Any]

START_NS = 1_000_000_000_000
DRIVE = reference_drive(30.0, start_ns=START_NS)
# The IMU is mounted askew, away from base_link.
T_BASE_IMU = se3.from_rotation_translation(se3.so3_exp([0.1, -0.05, 0.8]), [0.3, -0.2, 0.9])
T_BASE_ANTENNA = se3.from_rotation_translation(np.eye(3), [-0.4, 0.1, 1.5])
CAMERA = np.diag(np.array([0.2, 0.1, 0.1, 0.004, 0.004, 0.006]) ** 2)
# A noise-free drive: its samples are never frozen, however smooth they are.
QUIET = {'frozen_imu': 0, 'fixes': '', 'odometry': ''}


def base_pose(k: int) -> se3.Array:
    """Return the truth: the drive is that of the IMU."""
    return DRIVE.T_map_body[k] @ se3.inverse(T_BASE_IMU)


def stamp(k: int) -> int:
    return int(DRIVE.stamps_ns[k])


def imu(k: int, drive: ReferenceDrive = DRIVE, **changes: Any) -> Imu:
    message = Imu(header=messages.header(int(drive.stamps_ns[k]), 'imu'))
    rates, forces = drive.turn_rates[k], drive.forces[k]
    message.angular_velocity = Vector3(x=rates[0], y=rates[1], z=rates[2])
    message.linear_acceleration = Vector3(x=forces[0], y=forces[1], z=forces[2])
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def camera(k: int, *, off: Any = 0.0, frame: str = 'map') -> PoseWithCovarianceStamped:
    T = base_pose(k).copy()
    T[:3, 3] += off
    return PoseWithCovarianceStamped(
        header=messages.header(stamp(k), frame), pose=messages.pose_with_covariance(T, CAMERA)
    )


class Bench:
    """A node in lock-step, and what it published."""

    def __init__(self, node: EkfNode, namespace: str = '') -> None:
        self.node, self.prefix = node, namespace
        self.lockstep = LockStep([node])
        self.odometry: list[Odometry] = []
        self.tf: list[TransformStamped] = []
        self.lockstep.listen(f'{namespace}/odometry/filtered', self.odometry.append)
        self.lockstep.listen('/tf', lambda message: self.tf.extend(message.transforms))
        mounts = [
            TransformStamped(
                header=messages.header(0, 'base_link'),
                child_frame_id=child,
                transform=messages.transform_message(T),
            )
            for child, T in (('imu', T_BASE_IMU), ('gps', T_BASE_ANTENNA))
        ]
        self.lockstep.feed('/tf_static', TFMessage(transforms=mounts))

    def feed(self, topic: str, message: Any) -> None:
        self.lockstep.feed(f'{self.prefix}/{topic}', message)

    def drive(self, first: int, last: int, *, camera_every: int = 10) -> None:
        for k in range(first, last):
            if k % 100 == 0:
                self.lockstep.set_time(stamp(k))
            self.feed('imu', imu(k))
            if camera_every and k % camera_every == 0:
                self.feed('camera_pose', camera(k))

    def off(self, k: int) -> float:
        """Return how far the last output, which must be at sample k, is off the truth."""
        message = self.odometry[-1]
        assert messages.stamp_ns(message.header.stamp) == stamp(k)
        T = messages.transform_from_pose(message.pose.pose)
        return se3.distance(T, base_pose(k))[0]

    def problems(self) -> tuple[bytes, str]:
        self.node.check()
        status = self.node.diagnostics.status()
        return status.level, status.message


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


def odom(k: int, T_map_odom: se3.Array, covariance: se3.Array | None) -> Odometry:
    T = se3.inverse(T_map_odom) @ base_pose(k)
    return Odometry(
        header=messages.header(stamp(k), 'odom'),
        child_frame_id='base_link',
        pose=messages.pose_with_covariance(T, covariance),
    )


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


def fix(k: int, datum: GnssDatum) -> NavSatFix:
    east, north, up = (base_pose(k) @ T_BASE_ANTENNA)[:3, 3]
    radius = 6371000.0
    where = np.array(
        [
            datum.latitude_deg + np.degrees(north / radius),
            datum.longitude_deg
            + np.degrees(east / radius / np.cos(np.radians(datum.latitude_deg))),
            datum.altitude_m + up,
        ]
    )
    for _ in range(4):  # onto the ellipsoid
        off = np.array([east, north, up]) - datum.enu(*where)
        where += off * [0, 0, 1]
        where[0] += np.degrees(off[1] / radius)
        where[1] += np.degrees(off[0] / radius / np.cos(np.radians(datum.latitude_deg)))
    return NavSatFix(
        header=messages.header(stamp(k), 'gps'),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX),
        latitude=where[0],
        longitude=where[1],
        altitude=where[2],
        position_covariance=(0.5**2 * np.eye(3)).ravel(),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN,
    )


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


def test_without_an_imu_it_coasts_from_pose_to_pose(bench: Callable[..., Bench]) -> None:
    running = bench(use_imu=False)
    for k in range(0, 501, 10):
        running.feed('camera_pose', camera(k))
    assert running.off(500) < 0.3
    running.feed('camera_pose', camera(0))
    running.feed('camera_pose', camera(10))
    assert running.node.diagnostics.counted('clock jumps') == 1
    assert running.off(10) < 0.3
