"""Feed lidar_odometry sweeps of a simulated street and read what it publishes."""

import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from bags.street.drive import T_BASE_LIDAR as T_CAR_LIDAR
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError
from lcd_common.nodes import messages
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode

pytestmark = pytest.mark.ros
Make = Callable[..., Any]

# The LiDAR of these tests looks back to the left, and leans.
T_BASE_LIDAR = se3.from_rotation_translation(se3.so3_exp([0.05, 0.1, 2.2]), [0.4, -0.2, 1.6])


@dataclass(frozen=True)
class Sweep:
    stamp_ns: int
    cloud: PointCloud
    T_world_base: np.ndarray

    def message(self, **changes: Any) -> PointCloud2:
        values = {'cloud': self.cloud, 'stamp': self.stamp_ns, 'frame_id': 'lidar', **changes}
        return messages.cloud_message(**values)


@cache
def sweeps() -> tuple[Sweep, ...]:
    route = Route(speed=8.0).through([(0, 0), (30, 0), (30, 20)])
    town = StreetDrive(route, StreetConfig(seed=2), LidarConfig(columns=360))
    poses = town.truth().T_world_body
    T_lidar_car = se3.inverse(T_BASE_LIDAR) @ T_CAR_LIDAR
    scans = [(town.scan(i), i) for i in range(24, 34)]
    return tuple(Sweep(s.stamp_ns, s.cloud.transformed(T_lidar_car), poses[i]) for s, i in scans)


def mounting(child: str = 'lidar') -> TFMessage:
    stamped = TransformStamped(
        header=messages.header(1, 'base_link'),
        child_frame_id=child,
        transform=messages.transform_message(T_BASE_LIDAR),
    )
    return TFMessage(transforms=[stamped])


class Fed:
    """A node in lock-step, and what it published."""

    def __init__(self, node: LidarOdometryNode, prefix: str = '/', transform: bool = True) -> None:
        self.node, self.prefix = node, prefix
        self.lockstep = LockStep([node])
        self.odom: list[Any] = []
        self.tf: list[Any] = []
        self.lockstep.listen(prefix + 'odom', self.odom.append)
        self.lockstep.listen('/tf', lambda m: self.tf.extend(m.transforms))
        if transform:
            self.lockstep.feed('/tf_static', mounting())

    def feed(self, message: PointCloud2) -> None:
        self.lockstep.feed(self.prefix + 'points', message)

    def counted(self, cause: str) -> int:
        return self.node.diagnostics.counted(cause)

    def poses(self) -> list[np.ndarray]:
        return [messages.transform_from_pose(m.pose.pose) for m in self.odom]


def test_the_base_is_followed_whatever_way_the_lidar_is_mounted(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    for sweep in sweeps():
        fed.feed(sweep.message())
    assert len(fed.odom) == len(sweeps())
    np.testing.assert_allclose(fed.poses()[0], np.eye(4), atol=1e-12)
    T_world_odom = sweeps()[0].T_world_base
    for sweep, message, T in zip(sweeps(), fed.odom, fed.poses(), strict=True):
        metres, radians = se3.distance(T_world_odom @ T, sweep.T_world_base)
        assert metres < 0.1 and radians < 5e-3
        assert messages.stamp_ns(message.header.stamp) == sweep.stamp_ns
        assert (message.header.frame_id, message.child_frame_id) == ('odom', 'base_link')
    assert np.linalg.norm(fed.poses()[-1][:3, 3]) > 4.0


def test_tf_says_the_same_as_odom(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    for sweep in sweeps()[:4]:
        fed.feed(sweep.message())
    assert len(fed.tf) == 4
    for stamped, message, T in zip(fed.tf, fed.odom, fed.poses(), strict=True):
        assert stamped.header == message.header and stamped.child_frame_id == 'base_link'
        np.testing.assert_allclose(
            messages.transform_from_message(stamped.transform), T, atol=1e-12
        )
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_who_does_not_own_the_edge_keeps_off_tf(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False, publish_tf=False))
    fed.feed(sweeps()[0].message())
    assert len(fed.odom) == 1 and fed.tf == []


def test_a_second_authority_is_an_error(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    fed.feed(sweeps()[0].message())
    rival = TransformStamped(header=messages.header(5, 'odom'), child_frame_id='base_link')
    rival.transform.rotation.w = 1.0
    fed.lockstep.feed('/tf', TFMessage(transforms=[rival]))
    fed.feed(sweeps()[1].message())
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR and 'another node publishes' in status.message


def test_covariances_are_those_of_the_motions(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    estimates = []
    locate = fed.node._odometry.locate

    def noted(cloud: PointCloud, stamp: int) -> Any:
        estimates.append(locate(cloud, stamp))
        return estimates[-1]

    fed.node._odometry.locate = noted
    for sweep in sweeps():
        fed.feed(sweep.message())
    to_base = se3.adjoint(T_BASE_LIDAR)
    known = [messages.from_pose_with_covariance(m.pose) for m in fed.odom]
    assert known[0][1].max() <= 1e-12
    pairs = zip(pairwise(known), fed.odom[1:], estimates[1:], strict=True)
    for ((T_a, c_a), (T_b, c_b)), message, estimate in pairs:
        motion = se3.inverse(T_a) @ T_b
        grown = se3.relative_covariance(c_a, motion, c_b)
        np.testing.assert_allclose(
            grown, to_base @ estimate.growth @ to_base.T, rtol=1e-3, atol=1e-12
        )
        # The twist is the mean motion of the step in the vehicle's axes.
        twist = message.twist.twist
        vector = [twist.linear.x, twist.linear.y, twist.linear.z,
                  twist.angular.x, twist.angular.y, twist.angular.z]  # fmt: skip
        np.testing.assert_allclose(se3.exp(0.1 * np.array(vector)), motion, atol=1e-9)
        step = 0.1**2 * np.array(message.twist.covariance).reshape(6, 6)
        np.testing.assert_allclose(step, to_base @ estimate.covariance @ to_base.T, rtol=1e-9)
    assert fed.odom[5].twist.twist.linear.x > 3.0


def test_without_the_mounting_clouds_are_dropped_and_counted(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False), transform=False)
    fed.feed(sweeps()[0].message())
    assert fed.odom == [] and fed.counted('rejected points: no transform') == 1
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert '/tf_static does not connect base_link with lidar' in status.message
    fed.lockstep.feed('/tf_static', mounting())
    fed.feed(sweeps()[1].message())
    assert len(fed.odom) == 1
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_a_cloud_in_the_base_frame_needs_no_mounting(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False, base_frame='lidar'), transform=False)
    fed.feed(sweeps()[0].message())
    assert len(fed.odom) == 1 and fed.odom[0].child_frame_id == 'lidar'


def test_unusable_clouds_are_dropped_and_counted(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    good = sweeps()
    fed.feed(good[0].message())
    empty = PointCloud(np.empty((0, 3), np.float32))
    fed.feed(good[1].message(cloud=empty))
    fed.feed(good[2].message(cloud=PointCloud(np.full((900, 3), np.nan, np.float32))))
    wrong = good[3].message()
    wrong.fields = [field for field in wrong.fields if field.name != 'z']
    fed.feed(wrong)
    short = good[4].message()
    short.data = short.data[:100]
    fed.feed(short)
    assert len(fed.odom) == 1 and fed.counted('rejected points: unusable cloud') == 4
    fed.feed(good[5].message())
    assert len(fed.odom) == 2
    # The gap is bridged.
    motion = se3.inverse(good[0].T_world_base) @ good[5].T_world_base
    assert se3.distance(fed.poses()[1], motion)[0] < 0.2


def test_points_without_coordinates_are_counted(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    xyz = sweeps()[0].cloud.xyz.copy()
    xyz[:250] = np.nan
    fed.feed(sweeps()[0].message(cloud=PointCloud(xyz)))
    assert len(fed.odom) == 1
    assert fed.counted('points without coordinates (NaN)') == 250


def test_repeated_and_late_stamps_are_dropped(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    for index in (0, 1, 1, 0, 2):
        fed.feed(sweeps()[index].message())
    assert len(fed.odom) == 3
    assert fed.counted('rejected points: duplicate stamp') == 1
    assert fed.counted('rejected points: late stamp') == 1


@pytest.mark.parametrize('policy', ['restart', 'refuse'])
def test_a_clock_that_jumps_back(make: Make, policy: str) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False, on_time_jump=policy))
    for sweep in sweeps()[:4]:
        fed.feed(sweep.message(stamp=sweep.stamp_ns + 60_000_000_000))
    for sweep in sweeps()[5:8]:
        fed.feed(sweep.message())
    assert fed.counted('clock jumps in points') == 1
    if policy == 'restart':
        assert len(fed.odom) == 7
        np.testing.assert_allclose(fed.poses()[4], np.eye(4), atol=1e-12)
        motion = se3.inverse(sweeps()[5].T_world_base) @ sweeps()[7].T_world_base
        assert se3.distance(fed.poses()[6], motion)[0] < 0.1
        sigma = np.sqrt(np.diag(messages.from_pose_with_covariance(fed.odom[4].pose)[1]))
        assert sigma.max() <= 1e-6
        return
    assert len(fed.odom) == 4
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR and 'jumped back' in status.message
    fed.node.on_reset(Trigger.Request(), Trigger.Response())
    fed.feed(sweeps()[8].message())
    assert len(fed.odom) == 5
    np.testing.assert_allclose(fed.poses()[4], np.eye(4), atol=1e-12)
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_a_sweep_that_does_not_fit_is_told(make: Make) -> None:
    fed = Fed(make(LidarOdometryNode, threaded=False))
    for sweep in sweeps()[:6]:
        fed.feed(sweep.message())
    clutter = np.random.default_rng(0).uniform(-20, 20, (8000, 3)).astype(np.float32)
    fed.feed(sweeps()[6].message(cloud=PointCloud(clutter)))
    assert fed.counted('failed registrations') == 1 and fed.counted('scans') == 7
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.WARN and 'of the points fit the map' in status.message
    before, after = (messages.from_pose_with_covariance(m.pose)[1] for m in fed.odom[-2:])
    assert np.sqrt(after[5, 5]) > 1.0 > 100 * np.sqrt(before[5, 5])


def test_instances_do_not_mix(make: Make) -> None:
    nodes = [make(LidarOdometryNode, namespace=name, threaded=False) for name in ('left', 'right')]
    left, right = (Fed(node, f'/{node.get_namespace()[1:]}/') for node in nodes)
    for sweep in sweeps()[:3]:
        left.feed(sweep.message())
    right.feed(sweeps()[0].message())
    assert (len(left.odom), len(right.odom)) == (3, 1)


def test_the_queue_drops_the_oldest_and_counts(make: Make, spin_until: Callable[..., bool]) -> None:
    node = make(LidarOdometryNode, waiting_clouds=2)
    node._transforms.on_tf_static(mounting())
    gate, begun = threading.Event(), threading.Event()
    locate = node._odometry.locate

    def slow(cloud: PointCloud, stamp: int) -> Any:
        begun.set()
        assert gate.wait(20.0)
        return locate(cloud, stamp)

    node._odometry.locate = slow
    got: list[int] = []
    node._odom_out.publish = lambda m: got.append(messages.stamp_ns(m.header.stamp))
    node.on_points(sweeps()[0].message())
    assert begun.wait(10.0)
    for sweep in sweeps()[1:6]:
        node.on_points(sweep.message())
    gate.set()
    assert spin_until([node], lambda: len(got) == 3, 20.0)
    assert node.diagnostics.counted('dropped points: queue full') == 3
    assert got == [sweeps()[i].stamp_ns for i in (0, 4, 5)]


def test_quality_of_service_is_the_users_choice(make: Make) -> None:
    for reliable in (False, True):
        node = make(LidarOdometryNode, reliable_points=reliable)
        (points,) = [s for s in node.subscriptions if s.topic_name == '/points']
        asked = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        assert points.qos_profile.reliability == asked


def test_wrong_parameters_are_one_line(make: Make) -> None:
    with pytest.raises(ConfigError, match='min_range must be below'):
        make(LidarOdometryNode, min_range=90.0, max_range=50.0)
    with pytest.raises(ConfigError, match='on_time_jump'):
        make(LidarOdometryNode, on_time_jump='sometimes')


def test_the_command_explains_itself() -> None:
    command = Path(sys.executable).parent / 'lidar_odometry'
    answer = subprocess.run([command, '--help'], capture_output=True, text=True, check=True)
    for word in ('points', 'odom', 'min_range', 'publish_tf', 'ros2 run', 'polish = True'):
        assert word in answer.stdout
    wrong = subprocess.run(
        [command, '--ros-args', '-p', 'max_range:=0.1'], capture_output=True, text=True
    )
    assert wrong.returncode == 1
    assert wrong.stderr.strip().splitlines()[-1].startswith('error: parameter max_range')
