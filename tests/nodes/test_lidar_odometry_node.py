"""Feed lidar_odometry by hand and compare it with the registration that it runs."""

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from bags.street.drive import StreetDrive
from bags.street.lidar import LidarConfig
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError
from lcd_common.nodes import messages, qos
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryConfig, OdometryEstimate
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode

pytestmark = pytest.mark.ros
Make = Callable[..., Any]
_START = 60  # sweep: the vehicle drives


@cache
def _street() -> StreetDrive:
    return StreetDrive('loop', lidar=LidarConfig(columns=360))


@cache
def _cloud(step: int) -> PointCloud:
    return _street().scan(_START + step).cloud


def _sweep(step: int, stamp_ns: int | None = None) -> PointCloud2:
    stamp = drive.stamp(step) if stamp_ns is None else stamp_ns
    return messages.cloud_message(_cloud(step), stamp, 'lidar')


@cache
def _estimates(count: int) -> list[OdometryEstimate]:
    """Run the registration itself."""
    odometry = LidarOdometry(OdometryConfig(threads=1))
    return [odometry.register(_cloud(k), drive.stamp(k)) for k in range(count)]


class Fed:
    """A node in lock-step, and what it published."""

    def __init__(self, node: LidarOdometryNode, prefix: str = '/', transform: bool = True) -> None:
        self.node, self.prefix = node, prefix
        self.lockstep = LockStep([node])
        self.odom: list[Odometry] = []
        self.tf: list[TFMessage] = []
        self.lockstep.listen(prefix + 'odom', lambda m: self.odom.append(m))
        self.lockstep.listen('/tf', lambda m: self.tf.append(m))
        if transform:
            self.lockstep.feed('/tf_static', drive.static_transform())

    def take(self, *sweeps: PointCloud2) -> None:
        """Feed sweeps."""
        for sweep in sweeps:
            self.lockstep.feed(self.prefix + 'points', sweep)

    def counted(self, cause: str) -> int:
        """Return a counter of the node."""
        return self.node.diagnostics.counted(cause)

    def rejected(self) -> int:
        """Return how many sweeps were rejected, whatever the cause."""
        counts = self.node.diagnostics.counts()
        return sum(n for cause, n in counts.items() if cause.startswith('rejected points: '))

    def stamps(self) -> list[int]:
        """Return the stamps of the odometry."""
        return [messages.stamp_ns(m.header.stamp) for m in self.odom]


def _node(make: Make, **options: Any) -> Any:
    return make(LidarOdometryNode, threaded=False, threads=1, **options)


def _pose(message: Odometry) -> tuple[se3.Array, se3.Array]:
    T, covariance = messages.from_pose_with_covariance(message.pose)
    assert covariance is not None
    return T, covariance


def test_it_follows_the_base_wherever_the_lidar_is_mounted(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(*(_sweep(k) for k in range(4)))
    assert fed.stamps() == [drive.stamp(k) for k in range(4)]
    assert {(m.header.frame_id, m.child_frame_id) for m in fed.odom} == {('odom', 'base_link')}
    for message, estimate in zip(fed.odom, _estimates(4), strict=True):
        expected = drive.T_BASE_LIDAR @ estimate.T_odom_lidar @ se3.inverse(drive.T_BASE_LIDAR)
        np.testing.assert_allclose(_pose(message)[0], expected, atol=1e-4)
    # The mounting is turned by half a radian: the way of the base is that much turned, too.
    last = _pose(fed.odom[-1])[0]
    assert abs(se3.yaw(drive.T_BASE_LIDAR)) > 0.4
    driven = _street().truth().positions[[_START, _START + 3]]
    np.testing.assert_allclose(
        np.linalg.norm(last[:3, 3]), np.linalg.norm(driven[1] - driven[0]), atol=0.1
    )
    np.testing.assert_allclose(np.arctan2(last[1, 3], last[0, 3]), 0.5, atol=0.05)


def test_the_transform_on_tf_is_the_pose(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0), _sweep(1))
    assert len(fed.tf) == 2
    for sent, message in zip(fed.tf, fed.odom, strict=True):
        (stamped,) = sent.transforms
        assert stamped.header == message.header
        assert stamped.child_frame_id == 'base_link'
        np.testing.assert_allclose(
            messages.transform_from_message(stamped.transform), _pose(message)[0], atol=1e-12
        )


def test_tf_is_left_to_another_when_asked(make: Make) -> None:
    fed = Fed(_node(make, publish_tf=False, odom_frame='wheels', base_frame='body'))
    fed.take(_sweep(0))
    assert fed.counted('rejected points: no transform') == 1  # base_link is mounted, body is not
    mounted = drive.static_transform()
    mounted.transforms[0].header.frame_id = 'body'
    fed.lockstep.feed('/tf_static', mounted)
    fed.take(_sweep(1))
    assert '/tf' not in {p.topic_name for p in fed.node.publishers}
    assert fed.tf == []
    assert (fed.odom[0].header.frame_id, fed.odom[0].child_frame_id) == ('wheels', 'body')


def test_the_motion_between_two_messages_is_known_with_its_covariance(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(*(_sweep(k) for k in range(5)))
    poses = [_pose(message) for message in fed.odom]
    to_base = se3.adjoint(drive.T_BASE_LIDAR)
    for (T_a, cov_a), (T_b, cov_b), estimate in zip(
        poses[:-1], poses[1:], _estimates(5)[1:], strict=True
    ):
        assert estimate.growth is not None
        added = se3.relative_covariance(cov_a, se3.inverse(T_a) @ T_b, cov_b)
        assert added is not None
        np.testing.assert_allclose(
            added, to_base @ estimate.growth @ to_base.T, rtol=0.01, atol=1e-9
        )
    far = se3.relative_covariance(poses[0][1], se3.inverse(poses[0][0]) @ poses[4][0], poses[4][1])
    assert far is not None
    volumes = [np.linalg.slogdet(cov)[1] for _, cov in poses]
    assert all(b > a for a, b in pairwise(volumes))


def test_the_twist_is_the_motion_per_second_in_the_base_frame(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0), _sweep(1), _sweep(3))  # one was lost: the next step takes twice as long
    assert not np.any(fed.odom[0].twist.covariance)  # unknown: nothing has moved yet
    to_base = se3.adjoint(drive.T_BASE_LIDAR)
    direct = LidarOdometry(OdometryConfig(threads=1))
    estimates = [direct.register(_cloud(k), drive.stamp(k)) for k in (0, 1, 3)]
    for (before, now), estimate, seconds in zip(
        pairwise(fed.odom), estimates[1:], (0.1, 0.2), strict=True
    ):
        moved = se3.log(se3.inverse(_pose(before)[0]) @ _pose(now)[0]) / seconds
        twist = now.twist.twist
        got = [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in 'xyz']
        np.testing.assert_allclose(got, moved, atol=1e-6)
        assert estimate.covariance is not None
        np.testing.assert_allclose(
            np.reshape(now.twist.covariance, (6, 6)),
            to_base @ estimate.covariance @ to_base.T / seconds**2,
            rtol=0.01,
            atol=1e-9,
        )


def test_without_the_transform_nothing_is_guessed(make: Make) -> None:
    fed = Fed(_node(make), transform=False)
    fed.take(_sweep(0), _sweep(1))
    assert fed.odom == [] and fed.tf == []
    assert fed.counted('rejected points: no transform') == 2
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert '/tf_static does not connect base_link with lidar' in status.message
    assert 'base_frame' in status.message  # and what to do
    fed.lockstep.feed('/tf_static', drive.static_transform())
    fed.take(_sweep(2))
    assert fed.stamps() == [drive.stamp(2)]
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_the_frame_of_the_cloud_itself_needs_no_transform(make: Make) -> None:
    fed = Fed(_node(make, base_frame='lidar'), transform=False)
    fed.take(_sweep(0), _sweep(1))
    assert fed.odom[1].child_frame_id == 'lidar'
    np.testing.assert_allclose(_pose(fed.odom[1])[0], _estimates(2)[1].T_odom_lidar, atol=1e-4)


def test_points_that_are_no_numbers_are_left_out_and_counted(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0))
    xyz = _cloud(1).xyz.copy()
    holes = np.full((7, 3), np.nan, np.float32)
    holes[3] = np.inf
    with_holes = PointCloud(np.vstack([holes, xyz]))
    fed.take(messages.cloud_message(with_holes, drive.stamp(1), 'lidar'))
    assert 7 in fed.node.diagnostics.counts().values()
    assert fed.stamps() == [drive.stamp(0), drive.stamp(1)]
    expected = drive.T_BASE_LIDAR @ _estimates(2)[1].T_odom_lidar @ se3.inverse(drive.T_BASE_LIDAR)
    np.testing.assert_allclose(_pose(fed.odom[1])[0], expected, atol=1e-4)


def test_broken_sweeps_are_counted_and_the_next_one_goes_on(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0))
    nameless = _sweep(1)
    nameless.fields[0].name = 'range'
    fed.take(nameless)
    empty = _sweep(1, drive.stamp(1) + 1)
    empty.width, empty.row_step, empty.data = 0, 0, empty.data[:0]
    fed.take(empty)
    few = PointCloud(_cloud(1).xyz[:20])
    fed.take(messages.cloud_message(few, drive.stamp(1) + 2, 'lidar'))
    cut = _sweep(1, drive.stamp(1) + 3)
    cut.data = cut.data[:-5]
    fed.take(cut)
    assert fed.rejected() == 4
    assert len(fed.odom) == 1
    fed.take(_sweep(2))
    assert fed.stamps() == [drive.stamp(0), drive.stamp(2)]
    truth = _street().truth().T_world_body
    moved = se3.inverse(truth[_START]) @ truth[_START + 2]
    assert np.linalg.norm(_pose(fed.odom[1])[0][:3, 3]) == pytest.approx(
        np.linalg.norm(moved[:3, 3]), abs=0.1
    )
    assert fed.odom[1].twist.twist.linear.x > 0.0


def test_a_broken_first_sweep_does_not_start_the_odometry(make: Make) -> None:
    fed = Fed(_node(make))
    few = PointCloud(_cloud(0).xyz[:20])
    fed.take(messages.cloud_message(few, drive.stamp(0), 'lidar'))
    fed.take(_sweep(1))
    np.testing.assert_allclose(_pose(fed.odom[0])[0], np.eye(4), atol=1e-12)


def test_repeated_and_late_sweeps_are_not_registered(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0), _sweep(2), _sweep(2), _sweep(1), _sweep(3))
    assert fed.counted('rejected points: duplicate stamp') == 1
    assert fed.counted('rejected points: late stamp') == 1
    assert fed.stamps() == [drive.stamp(k) for k in (0, 2, 3)]


def test_a_looped_bag_starts_again_at_the_origin(make: Make) -> None:
    fed = Fed(_node(make))
    late = drive.stamp(30)
    fed.take(_sweep(0, late), _sweep(1, late + drive.STEP_NS), _sweep(0), _sweep(1))
    assert fed.counted('clock jumps in points') == 1
    first, again = fed.odom[:2], fed.odom[2:]
    np.testing.assert_allclose(_pose(again[0])[0], np.eye(4), atol=1e-12)
    assert np.trace(_pose(again[0])[1]) < 1e-10  # the covariance starts anew with the pose
    np.testing.assert_allclose(_pose(again[1])[0], _pose(first[1])[0], atol=1e-4)


def test_a_looped_bag_is_refused_until_reset(make: Make) -> None:
    fed = Fed(_node(make, on_time_jump='refuse'))
    fed.take(_sweep(0, drive.stamp(30)), _sweep(0), _sweep(1))
    assert len(fed.odom) == 1
    assert fed.counted('rejected points: clock jumped back') == 1
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert 'refusing input until ~/reset' in status.message
    assert fed.node.on_reset(Trigger.Request(), Trigger.Response()).success
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK
    fed.take(_sweep(1))
    np.testing.assert_allclose(_pose(fed.odom[-1])[0], np.eye(4), atol=1e-12)


def test_reset_starts_again_at_the_origin(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(_sweep(0), _sweep(1))
    assert np.linalg.norm(_pose(fed.odom[-1])[0][:3, 3]) > 0.1
    answer = fed.node.on_reset(Trigger.Request(), Trigger.Response())
    assert answer.success and answer.message
    fed.take(_sweep(2))
    np.testing.assert_allclose(_pose(fed.odom[-1])[0], np.eye(4), atol=1e-12)
    assert not np.any(fed.odom[-1].twist.covariance)


def test_a_sweep_of_another_place_is_reported(make: Make) -> None:
    fed = Fed(_node(make))
    fed.take(*(_sweep(k) for k in range(6)))
    before = _pose(fed.odom[-1])[1]
    random = np.random.default_rng(0)
    elsewhere = PointCloud(random.uniform(-40, 40, (4000, 3)).astype(np.float32))
    fed.take(messages.cloud_message(elsewhere, drive.stamp(6), 'lidar'))
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.WARN
    assert 'of the points fit the map' in status.message
    assert np.trace(_pose(fed.odom[-1])[1]) > 10 * np.trace(before)
    fed.take(_sweep(7))
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_namespaces_remaps_and_two_in_one_process(make: Make) -> None:
    remap = ['--ros-args', '-r', 'points:=/velodyne_points']
    left = Fed(_node(make, namespace='left'), '/left/')
    right = _node(make, namespace='right', cli_args=remap)
    other = Fed(right, '/right/')
    left.take(_sweep(0), _sweep(1))
    other.lockstep.feed('/velodyne_points', _sweep(1))
    assert len(left.odom) == 2 and len(other.odom) == 1
    np.testing.assert_allclose(_pose(other.odom[0])[0], np.eye(4), atol=1e-12)
    names = {s.topic_name for s in right.subscriptions}
    assert {'/velodyne_points', '/tf_static'} <= names
    assert {'/right/odom', '/tf', '/diagnostics'} <= {p.topic_name for p in right.publishers}
    served = dict(right.get_service_names_and_types_by_node('lidar_odometry', '/right'))
    assert '/right/lidar_odometry/reset' in served


def test_threads_deliver_and_reset(make: Make, spin_until: Callable[..., bool]) -> None:
    node = make(LidarOdometryNode, threads=1)
    odom: list[Odometry] = []
    node.create_subscription(Odometry, 'odom', odom.append, qos.RELIABLE)
    node._transforms.on_tf_static(drive.static_transform())
    for step in range(3):
        node.on_points(_sweep(step))
    assert spin_until([node], lambda: len(odom) == 3)
    expected = drive.T_BASE_LIDAR @ _estimates(3)[2].T_odom_lidar @ se3.inverse(drive.T_BASE_LIDAR)
    np.testing.assert_allclose(_pose(odom[2])[0], expected, atol=1e-4)
    node.on_reset(Trigger.Request(), Trigger.Response())
    node.on_points(_sweep(3))
    assert spin_until([node], lambda: len(odom) == 4)
    np.testing.assert_allclose(_pose(odom[3])[0], np.eye(4), atol=1e-12)


def test_the_reliable_parameter_asks_for_every_cloud(make: Make) -> None:
    for reliable, profile in ((False, qos.SENSOR), (True, qos.SENSOR_RELIABLE)):
        node = _node(make, reliable_points=reliable)
        (points,) = [s for s in node.subscriptions if s.topic_name == '/points']
        assert points.qos_profile.reliability == profile.reliability


def test_a_wrong_parameter_is_named(make: Make) -> None:
    with pytest.raises(ConfigError, match='on_time_jump must be one of restart, refuse'):
        make(LidarOdometryNode, on_time_jump='panic')
    with pytest.raises(ConfigError, match='min_range must be below max_range'):
        make(LidarOdometryNode, min_range=50.0, max_range=20.0)


def test_help_names_topics_and_services() -> None:
    code = 'from lcd_loop_closure.nodes.lidar_odometry_node import main; raise SystemExit(main())'
    run = subprocess.run(
        [sys.executable, '-c', code, '--help'], capture_output=True, text=True, check=True
    )
    for word in ('Subscribes', 'Publishes', 'points', 'odom', '~/reset', 'ros2 run'):
        assert word in run.stdout
