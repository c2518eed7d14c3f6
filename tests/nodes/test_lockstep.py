"""Lock-step replay: routing by resolved name, order, clock and timers, equal bytes on every run."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, PointCloud2
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from bags.records import TruthPose
from bags.street import LidarConfig, StreetConfig, StreetDrive
from lcd_common.errors import ConfigError, DataError
from lcd_common.nodes import messages
from lcd_common.nodes.transforms import StaticTransforms

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('ros')]


class Echo(Node):
    """Answer every `in` with two `out`; note everything that arrives."""

    def __init__(self, name: str = 'echo', **options: object) -> None:
        super().__init__(name, **options)
        self.seen: list[str] = []
        self.out = self.create_publisher(String, 'out', 10)
        self.create_subscription(String, 'in', self.on_in, 10)

    def on_in(self, message: String) -> None:
        self.seen.append(message.data)
        self.out.publish(String(data=message.data + 'a'))
        self.out.publish(serialize_message(String(data=message.data + 'b')))


class Odometer(Node):
    """Sum up points and IMU in an order-sensitive way and publish the sum with a cloud's stamp."""

    def __init__(self, **options: object) -> None:
        super().__init__('odometer', **options)
        self.static = StaticTransforms(self)
        self.sum = 0.0
        self.knew_lidar: list[bool] = []
        self.times: list[int] = []
        self.ticks: list[int] = []
        self.out = self.create_publisher(PoseStamped, 'pose', 10)
        self.create_subscription(PointCloud2, 'points', self.on_points, 10)
        self.create_subscription(Imu, 'imu', self.on_imu, 10)
        self.create_timer(0.5, lambda: self.ticks.append(self.get_clock().now().nanoseconds))

    def on_imu(self, message: Imu) -> None:
        self.sum = 0.9 * self.sum + message.angular_velocity.z

    def on_points(self, message: PointCloud2) -> None:
        self.knew_lidar.append(self.static.lookup('base_link', 'lidar') is not None)
        self.times.append(self.get_clock().now().nanoseconds)
        self.sum += float(messages.cloud_from_message(message).xyz.sum(dtype=np.float64))
        pose = PoseStamped(header=message.header)
        pose.pose.position.x = self.sum
        self.out.publish(pose)


@pytest.fixture
def nodes() -> Iterator[list[Node]]:
    made: list[Node] = []
    yield made
    for node in made:
        node.destroy_node()


@pytest.fixture(scope='module')
def drive() -> StreetDrive:
    return StreetDrive(settings=StreetConfig(imu_rate=50.0), lidar=LidarConfig(columns=32))


def test_messages_arrive_first_in_first_out(nodes: list[Node]) -> None:
    first = Echo()
    second = Echo('second', cli_args=['--ros-args', '-r', 'in:=/out', '-r', 'out:=/last'])
    nodes += [first, second]
    lockstep = LockStep(nodes)
    last: list[str] = []
    lockstep.listen('/last', lambda message: last.append(message.data))
    lockstep.feed('/in', String(data='1'))
    lockstep.feed('/in', String(data='2'))
    assert first.seen == ['1', '2']
    assert second.seen == ['1a', '1b', '2a', '2b']
    assert last == ['1aa', '1ab', '1ba', '1bb', '2aa', '2ab', '2ba', '2bb']


def test_two_instances_of_a_class_in_namespaces_stay_apart(nodes: list[Node]) -> None:
    nodes += [Echo(namespace='left'), Echo(namespace='right')]
    lockstep = LockStep(nodes)
    heard: Counter[str] = Counter()
    for side in ('left', 'right'):
        lockstep.listen(f'/{side}/out', lambda _, side=side: heard.update([side]))
    lockstep.feed('/left/in', String(data='x'))
    assert [node.seen for node in nodes] == [['x'], []]
    assert heard == {'left': 2}


def test_a_node_hears_itself(nodes: list[Node]) -> None:
    node = Echo(cli_args=['--ros-args', '-r', 'out:=back'])
    nodes.append(node)
    node.create_subscription(String, 'back', lambda m: node.seen.append(m.data.upper()), 10)
    LockStep(nodes).feed('/in', String(data='x'))
    assert node.seen == ['x', 'XA', 'XB']


def test_raw_listeners_and_raw_feeds_get_and_give_bytes(nodes: list[Node]) -> None:
    nodes.append(Echo())
    lockstep = LockStep(nodes)
    raw: list[bytes] = []
    lockstep.listen('/out', raw.append, raw=True)
    lockstep.feed('/in', serialize_message(String(data='x')), String)
    assert [deserialize_message(data, String).data for data in raw] == ['xa', 'xb']
    with pytest.raises(TypeError, match='message_class'):
        lockstep.feed('/in', b'')


def test_a_publisher_made_later_is_carried_too(nodes: list[Node]) -> None:
    nodes.append(Echo())
    lockstep = LockStep(nodes)
    heard: list[str] = []
    lockstep.listen('/late', lambda message: heard.append(message.data))
    late = nodes[0].create_publisher(String, 'late', 10)
    lockstep.feed('/in', String(data='x'))
    late.publish(String(data='y'))
    lockstep.feed('/in', String(data='x'))
    assert heard == ['y']


def test_a_wrong_type_is_refused_as_rclpy_does(nodes: list[Node]) -> None:
    nodes.append(Echo())
    LockStep(nodes)
    with pytest.raises(TypeError, match='Expected'):
        nodes[0].out.publish(Time())


def test_an_error_in_a_callback_comes_through_and_leaves_nothing_behind(nodes: list[Node]) -> None:
    node = Echo()
    nodes.append(node)
    lockstep = LockStep(nodes)
    node.create_subscription(String, 'out', lambda _: 1 / 0, 10)
    with pytest.raises(ZeroDivisionError):
        lockstep.feed('/in', String(data='x'))
    lockstep.feed('/other', String(data='x'))
    assert lockstep.delivered['/out'] == 0


def test_threads_are_refused(nodes: list[Node]) -> None:
    node = Echo()
    nodes.append(node)
    node.declare_parameter('threaded', True)
    with pytest.raises(ConfigError, match='threaded:=false'):
        LockStep(nodes)


def test_a_drive_gives_time_transforms_and_timers(nodes: list[Node], drive: StreetDrive) -> None:
    node = Odometer()
    nodes.append(node)
    fed = LockStep(nodes).run(drive, start_s=1.0, duration_s=2.0, progress=False)
    assert fed == {'/tf_static': 1, '/points': 21, '/imu': 101}
    assert all(node.knew_lidar) and len(node.knew_lidar) == 21
    first = drive.streams()[0].first_ns
    assert first is not None
    assert node.times == [first + 1_000_000_000 + 100_000_000 * i for i in range(21)]
    # Counted from the first stamp of the replay, whatever the wall clock did before.
    assert node.ticks == [first + 1_000_000_000 + 500_000_000 * i for i in range(1, 5)]


class Late(Echo):
    """Hold every answer back until it is flushed."""

    def __init__(self, **options: object) -> None:
        super().__init__('late', **options)
        self.held: list[str] = []
        self.create_subscription(PointCloud2, 'points', self.on_points, 10)

    def on_points(self, message: PointCloud2) -> None:
        self.held.append('x')

    def flush(self) -> None:
        self.out.publish(String(data=''.join(self.held)))
        self.held.clear()


def test_what_nodes_hold_back_is_delivered_at_the_end(
    nodes: list[Node], drive: StreetDrive
) -> None:
    echo = Echo(cli_args=['--ros-args', '-r', 'in:=out', '-r', 'out:=last'])
    nodes += [Late(), echo]
    lockstep = LockStep(nodes)
    lockstep.run(drive, duration_s=0.2, progress=False)
    assert echo.seen == ['xxx']
    lockstep.flush()
    assert echo.seen == ['xxx', '']


def test_two_runs_give_identical_bytes(drive: StreetDrive) -> None:
    runs = []
    for _ in range(2):
        node = Odometer()
        lockstep = LockStep([node])
        heard: list[bytes] = []
        lockstep.listen('/pose', heard.append, raw=True)
        lockstep.run(drive, duration_s=1.0, progress=False)
        runs.append(heard)
        node.destroy_node()
    assert len(runs[0]) == 11
    assert runs[0] == runs[1]


def test_observers_get_what_no_node_takes(nodes: list[Node], drive: StreetDrive) -> None:
    nodes.append(Echo())
    lockstep = LockStep(nodes)
    poses: list[PoseStamped] = []
    static: list[TFMessage] = []
    lockstep.listen('/ground_truth/pose', poses.append)
    lockstep.listen('/tf_static', static.append)
    fed = lockstep.run(drive, duration_s=0.5, progress=False)
    truth = [r for r in drive.records(end_ns=1_700_000_000_500_000_000) if isinstance(r, TruthPose)]
    assert fed == {'/tf_static': 1, '/ground_truth/pose': 6} and len(static[0].transforms) == 3
    for pose, expected in zip(poses, truth, strict=True):
        np.testing.assert_allclose(
            messages.transform_from_pose(pose.pose), expected.T_world_base, atol=1e-9
        )
        assert messages.stamp_ns(pose.header.stamp) == expected.stamp_ns


def test_a_start_behind_the_end_is_an_error(nodes: list[Node], drive: StreetDrive) -> None:
    nodes.append(Echo())
    with pytest.raises(DataError, match='must lie within'):
        LockStep(nodes).run(drive, start_s=1e4, progress=False)
