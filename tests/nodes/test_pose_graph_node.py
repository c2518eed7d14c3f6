"""Feed pose_graph by hand and read what it publishes."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus, PointCloud2
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from bags.nodes.lockstep import LockStep
from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_loop_closure.gnss import GnssDatum
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.map_store import load_map
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from lcd_loop_closure.nodes.positions_message import positions_from_message
from lcd_msgs.msg import LoopConstraintArray
from lcd_msgs.srv import AddLoop, LoadMap, RemoveLoop, SaveMap

pytestmark = pytest.mark.ros
Make = Callable[..., Any]
ROUND = 126  # steps of one round
DRIFT = 3e-4


class Fed:
    """Nodes in lock-step, and what they published by topic."""

    def __init__(self, *nodes: PoseGraphNode, prefix: str = '/') -> None:
        self.node, self.prefix = nodes[0], prefix
        self.lockstep = LockStep(nodes)
        self.heard: dict[str, list[Any]] = defaultdict(list)
        for topic in ('path', 'pose', 'graph/keyframes', 'loops', 'loop_markers', 'map'):
            self.lockstep.listen(prefix + topic, self.heard[topic].append)
        self.lockstep.listen('/tf', self.heard['tf'].append)
        self.lockstep.feed('/tf_static', drive.static_transform())

    def feed(self, topic: str, message: Any) -> None:
        """Feed a message on a relative topic."""
        self.lockstep.feed(self.prefix + topic, message)

    def drive(self, steps: range, drift: float = 0.0, first_id: int = 0) -> None:
        """Feed odometry and the keyframe of every step."""
        for step in steps:
            self.feed('odom', drive.odom_message(step, drift) if step % 10 == 0 else _odom(step))
            self.feed('keyframe', drive.keyframe(step, drift, first_id))

    def settle(self) -> None:
        """Deliver what was published outside of a feed."""
        self.lockstep.feed('/nothing', TFMessage())

    def refresh(self) -> None:
        """Do what the node's timer does."""
        self.node.refresh()
        self.settle()

    def path(self) -> np.ndarray:
        """Return the poses of the last path."""
        self.settle()
        poses = self.heard['path'][-1].poses
        return np.array([messages.transform_from_pose(p.pose) for p in poses]).reshape(-1, 4, 4)

    def counted(self, cause: str) -> int:
        """Return a counter of the node."""
        return self.node.diagnostics.counted(cause)


def _odom(step: int) -> Any:
    """Return odometry without its covariance, which takes long to add up."""
    return drive.odom_message(step, covariance=False)


def _second_round(fed: Fed, loops: list[tuple[int, int]], wrong_by_m: float = 0.0) -> None:
    for step in range(ROUND + 6):
        fed.feed('keyframe', drive.keyframe(step, DRIFT))
    for match, query in loops:
        fed.feed('loop_constraint', drive.loop(match, query, wrong_by_m))


TRUE_LOOPS = [(0, ROUND), (2, ROUND + 2), (4, ROUND + 4)]


def _errors(fed: Fed) -> np.ndarray:
    truth = np.array([drive.true_pose(k) for k in range(len(fed.path()))])
    return np.linalg.norm(fed.path()[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_loops_correct_the_path_and_are_shown(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    _second_round(fed, [])
    before = _errors(fed).max()
    _second_round_loops = [drive.loop(*pair) for pair in TRUE_LOOPS]
    for message in _second_round_loops:
        fed.feed('loop_constraint', message)
    fed.feed('loop_constraint', drive.loop(30, 90, status=LoopStatus.REJECTED_FITNESS))
    fed.refresh()
    assert before > 0.5
    assert _errors(fed).max() < 0.25 * before
    positions = positions_from_message(fed.heard['graph/keyframes'][-1])
    np.testing.assert_array_equal(positions.ids, np.arange(ROUND + 6))
    np.testing.assert_allclose(positions.xyz, fed.path()[:, :3, 3], atol=1e-5)
    array: LoopConstraintArray = fed.heard['loops'][-1]
    assert [(m.match_id, m.query_id, m.status) for m in array.loops] == [
        (match, query, 0) for match, query in TRUE_LOOPS
    ]
    accepted, rejected = fed.heard['loop_markers'][-1].markers
    assert (accepted.ns, len(accepted.points)) == ('accepted', 6)
    assert accepted.color.g > accepted.color.r
    assert (rejected.ns, len(rejected.points)) == ('rejected', 2)
    assert rejected.color.r > rejected.color.g
    end = accepted.points[1]
    np.testing.assert_allclose([end.x, end.y, end.z], fed.path()[ROUND, :3, 3], atol=1e-6)


def test_a_false_loop_does_not_bend_the_path_and_is_reported(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    _second_round(fed, TRUE_LOOPS)
    before = fed.path()
    fed.feed('loop_constraint', drive.loop(20, 80, wrong_by_m=8.0))
    assert np.abs(fed.path()[:, :3, 3] - before[:, :3, 3]).max() < 0.05
    fed.refresh()
    last = fed.heard['loops'][-1].loops[-1]
    assert (last.match_id, last.query_id) == (20, 80)
    assert last.status in (last.REJECTED_BY_GRAPH, last.REJECTED_INCONSISTENT)
    assert last.reason
    assert len(fed.heard['loop_markers'][-1].markers[1].points) == 2


def test_map_odom_and_pose_follow_odometry(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.feed('odom', _odom(0))
    assert len(fed.heard['tf']) == 1  # the tree is whole from the first odometry
    assert fed.heard['pose'] == []
    fed.drive(range(1, 21))
    for step in (21, 22):
        fed.feed('odom', drive.odom_message(step))
    transform = fed.heard['tf'][-1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'odom')
    assert messages.stamp_ns(transform.header.stamp) == drive.stamp(22)
    T_map_odom = messages.transform_from_message(transform.transform)
    pose = fed.heard['pose'][-1]
    assert pose.header.frame_id == 'map'
    T_map_base, covariance = messages.from_pose_with_covariance(pose.pose)
    np.testing.assert_allclose(T_map_base, T_map_odom @ drive.odometry_pose(22), atol=1e-9)
    assert covariance is not None
    at_21 = messages.from_pose_with_covariance(fed.heard['pose'][-2].pose)[1]
    assert at_21 is not None
    assert np.trace(covariance[:3, :3]) > np.trace(at_21[:3, :3]) > 0


def test_publish_tf_false_leaves_the_edge_to_others(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False, publish_tf=False))
    fed.drive(range(3))
    assert fed.heard['tf'] == []
    assert len(fed.heard['pose']) == 2
    assert not [p for p in fed.node.publishers if p.topic_name == '/tf']


def test_two_authorities_are_an_error_while_there_are_two(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.drive(range(3))
    fed.refresh()
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK
    rival = TransformStamped(header=messages.header(drive.stamp(3), 'map'), child_frame_id='odom')
    fed.lockstep.feed('/tf', TFMessage(transforms=[rival]))
    fed.refresh()
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert 'another node publishes map -> odom' in status.message
    fed.refresh()
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_broken_and_early_constraints_are_counted_or_wait(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.drive(range(5))
    nan = drive.loop(0, 4)
    nan.transform.pose.position.y = float('nan')
    bad = drive.loop(0, 4)
    bad.transform.covariance[0] = -1.0
    unheard = drive.loop(0, 4)
    unheard.status = 77
    for message in (nan, bad, unheard):
        fed.feed('loop_constraint', message)
    assert fed.counted('rejected loop_constraint: broken') == 3
    fed.feed('loop_constraint', drive.loop(0, 6))  # its keyframe comes later
    assert fed.counted('loops waits') == 1
    fed.drive(range(5, 8))
    assert [loop.query_id for loop in fed.node.map.graph.loops()] == [6]
    broken = drive.keyframe(8)
    broken.motion.covariance[0] = float('inf')
    fed.feed('keyframe', broken)
    assert fed.counted('rejected keyframe: broken') == 1
    fed.feed('keyframe', drive.keyframe(7))
    assert fed.counted('rejected keyframe: out of order') == 1
    fed.feed('keyframe', drive.keyframe(9))
    assert fed.counted('keyframes missed') == 1
    assert len(fed.path()) == 9
    assert se3.distance(fed.path()[-1], drive.true_pose(9))[0] < 0.05


def test_odometry_in_another_frame_is_refused_with_a_remedy(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    wheel = drive.odom_message(0)
    wheel.header.frame_id = 'wheel_odom'
    fed.feed('odom', wheel)
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert 'odom is in wheel_odom, expected odom: set odom_frame' in status.message
    other = Fed(make(PoseGraphNode, namespace='b', threaded=False, odom_frame='wheel_odom'),
                prefix='/b/')  # fmt: skip
    other.feed('odom', wheel)
    assert other.heard['tf'][-1].transforms[0].child_frame_id == 'wheel_odom'


def test_a_new_session_restarts_the_map_or_is_refused(make: Make) -> None:
    restarting = Fed(make(PoseGraphNode, threaded=False))
    refusing = Fed(make(PoseGraphNode, threaded=False, on_time_jump='refuse'))
    for fed in (restarting, refusing):
        fed.drive(range(20))
        fed.drive(range(4))
    assert len(restarting.path()) == 4
    assert restarting.counted('sessions restarted') == 1
    assert restarting.counted('clock jumps in odom') == 1
    assert len(restarting.heard['tf']) == 24
    assert len(refusing.path()) == 20
    assert len(refusing.heard['tf']) == 20
    assert refusing.node.diagnostics.status().level == DiagnosticStatus.ERROR
    refusing.node.map_services.on_reset(Trigger.Request(), Trigger.Response())
    assert len(refusing.path()) == 0
    refusing.drive(range(4))
    assert len(refusing.path()) == 4
    assert refusing.node.diagnostics.status().level == DiagnosticStatus.OK


def test_pause_keeps_the_map_and_resuming_bridges_the_gap(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.drive(range(5))
    fed.node.map_services.on_pause(SetBool.Request(data=True), SetBool.Response())
    fed.drive(range(5, 9))
    fed.feed('loop_constraint', drive.loop(0, 4))
    assert len(fed.path()) == 5
    assert len(fed.heard['tf']) == 9
    assert fed.counted('ignored keyframes: paused') == 4
    assert fed.counted('ignored loops: paused') == 1
    fed.node.map_services.on_pause(SetBool.Request(data=False), SetBool.Response())
    fed.drive(range(9, 12))
    assert len(fed.path()) == 8
    assert se3.distance(fed.path()[-1], drive.true_pose(11))[0] < 0.05


def test_loops_by_hand(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    _second_round(fed, [])
    before = _errors(fed).max()
    request = AddLoop.Request(match_id=0, query_id=ROUND)
    request.transform = drive.loop(0, ROUND).transform
    services = fed.node.map_services
    assert services.on_add_loop(request, AddLoop.Response()).success
    assert _errors(fed).max() < 0.5 * before
    removed = services.on_remove_loop(
        RemoveLoop.Request(match_id=0, query_id=ROUND), RemoveLoop.Response()
    )
    assert removed.success
    assert _errors(fed).max() == pytest.approx(before, rel=0.1)
    assert fed.node.map.graph.loops()[0].status is LoopStatus.REJECTED_BY_HAND
    again = services.on_remove_loop(
        RemoveLoop.Request(match_id=0, query_id=9), RemoveLoop.Response()
    )
    assert not again.success and again.message == 'there is no loop 0 - 9'
    request.transform.covariance = np.zeros(36)
    answer = services.on_add_loop(request, AddLoop.Response())
    assert not answer.success and 'positive definite' in answer.message
    unknown = AddLoop.Request(match_id=0, query_id=9999, transform=drive.loop(0, 9).transform)
    answer = services.on_add_loop(unknown, AddLoop.Response())
    assert not answer.success and 'expected a loop between' in answer.message


def test_satellite_fixes_tie_the_map_to_the_earth(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False, use_gps=True, gnss__baseline=5.0))
    datum = GnssDatum(49.0, 8.4, 110.0)
    antenna = TransformStamped(
        header=messages.header(1, 'base_link'),
        child_frame_id='gps',
        transform=messages.transform_message(se3.exp([-0.6, 0, 1.6, 0, 0, 0])),
    )
    fix = NavSatFix(header=messages.header(drive.stamp(0), 'gps'))
    fix.status.status = NavSatStatus.STATUS_FIX
    fix.position_covariance = np.diag([1.0, 1.0, 4.0]).ravel()
    fed.feed('gps/fix', fix)
    assert fed.counted('rejected gps/fix: unusable') == 1  # covariance type unknown
    fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
    fed.feed('gps/fix', fix)
    assert fed.counted('rejected gps/fix: no transform') == 1
    fed.lockstep.feed('/tf_static', TFMessage(transforms=[antenna]))
    for step in range(60):
        fed.drive(range(step, step + 1))
        if step % 5 == 0:
            xyz = drive.true_pose(step) @ np.array([-0.6, 0, 1.6, 1.0])
            moved = NavSatFix(header=messages.header(drive.stamp(step), 'gps'))
            moved.latitude = datum.latitude_deg + np.degrees(xyz[1] / 6378137.0)
            moved.longitude = datum.longitude_deg + np.degrees(
                xyz[0] / 6378137.0 / np.cos(np.radians(datum.latitude_deg))
            )
            moved.altitude = datum.altitude_m + xyz[2]
            moved.position_covariance = fix.position_covariance
            moved.status.status = NavSatStatus.STATUS_FIX
            moved.position_covariance_type = NavSatFix.COVARIANCE_TYPE_KNOWN
            fed.feed('gps/fix', moved)
    snapshot = fed.node.map.graph.snapshot()
    assert len(snapshot.gnss) >= 10
    assert snapshot.T_enu_map is not None
    fix.status.status = NavSatStatus.STATUS_NO_FIX
    fed.feed('gps/fix', fix)
    assert fed.counted('rejected gps/fix: unusable') == 2


def test_the_imu_levels_a_new_map_and_is_not_begun_in_the_middle(make: Make) -> None:
    tilt = se3.exp([0, 0, 0, 0.0, 0.05, 0.0])  # the road climbs: gravity is not along -z
    sensor = TransformStamped(
        header=messages.header(1, 'base_link'),
        child_frame_id='imu',
        transform=messages.transform_message(np.eye(4)),
    )
    sample = Imu()
    sample.header.frame_id = 'imu'
    force = tilt[:3, :3].T @ [0.0, 0.0, 9.81]
    sample.linear_acceleration.x, _, sample.linear_acceleration.z = map(float, force)
    fed = Fed(make(PoseGraphNode, threaded=False, use_imu=True))
    fed.feed('imu', sample)
    assert fed.counted('rejected imu: no transform') == 1
    fed.lockstep.feed('/tf_static', TFMessage(transforms=[sensor]))
    for k in range(60):
        sample.header.stamp = messages.time_message(drive.stamp(0) - (60 - k) * 10_000_000)
        fed.feed('imu', sample)
    fed.feed('imu', sample)
    assert fed.counted('rejected imu: unusable') == 1
    fed.drive(range(1))
    np.testing.assert_allclose(fed.path()[0], tilt, atol=1e-3)

    late = Fed(make(PoseGraphNode, namespace='late', threaded=False, use_imu=True), prefix='/late/')
    late.drive(range(1))
    late.lockstep.feed('/tf_static', TFMessage(transforms=[sensor]))
    late.feed('imu', sample)
    assert late.counted('rejected imu: too late') == 1
    np.testing.assert_allclose(late.path()[0], np.eye(4), atol=1e-9)


def test_a_map_is_saved_and_gone_on_in(make: Make, tmp_path: Path) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    _second_round(fed, TRUE_LOOPS)
    (answer,) = _finished(
        fed.node.map_services.on_save_map(
            SaveMap.Request(path=str(tmp_path / 'map')), SaveMap.Response()
        )
    )
    assert answer.success, answer.message
    count = ROUND + 6
    assert len(load_map(tmp_path / 'map').graph) == count

    later = Fed(make(PoseGraphNode, threaded=False, map=str(tmp_path / 'map')))
    later.node.publish_graph()
    np.testing.assert_allclose(later.path()[:, :3, 3], fed.path()[:, :3, 3], atol=0.02)
    later.feed('odom', _odom(0))
    assert later.heard['tf'] == []  # nobody knows yet where odometry starts
    later.feed('keyframe', drive.keyframe(0))
    assert later.counted('rejected keyframe: other session') == 1
    assert 'load it in loop_closure too' in later.node.diagnostics.status().message
    later.drive(range(1, 6), first_id=count)
    assert later.node.diagnostics.status().level == DiagnosticStatus.WARN
    for step in (2, 4):
        later.feed('loop_constraint', drive.loop(step, step, query_id=count + step))
    assert later.node.diagnostics.status().level == DiagnosticStatus.OK
    later.feed('odom', _odom(6))
    assert len(later.heard['tf']) == 1
    assert len(later.path()) == count + 5
    assert se3.distance(later.path()[-1], drive.true_pose(5))[0] < 0.5


def test_a_person_says_where_the_vehicle_is(make: Make, tmp_path: Path) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.drive(range(4))
    _finished(
        fed.node.map_services.on_save_map(
            SaveMap.Request(path=str(tmp_path / 'map')), SaveMap.Response()
        )
    )
    answer = fed.node.map_services.on_load_map(
        LoadMap.Request(path=str(tmp_path / 'map')), LoadMap.Response()
    )
    assert answer.success and answer.message.startswith('4 keyframes')
    fed.drive(range(10, 12), first_id=0)
    pose = PoseWithCovarianceStamped()
    pose.pose.pose = messages.pose_message(drive.true_pose(11))
    fed.feed('initialpose', pose)
    np.testing.assert_allclose(fed.path()[-1], drive.true_pose(11), atol=1e-6)
    fed.feed('initialpose', pose)
    assert fed.counted('rejected initialpose: not needed') == 1


def test_saving_and_loading_answer_what_went_wrong(make: Make, tmp_path: Path) -> None:
    node = make(PoseGraphNode, threaded=False)
    (answer,) = _finished(
        node.map_services.on_save_map(SaveMap.Request(path=str(tmp_path)), SaveMap.Response())
    )
    assert not answer.success and 'no keyframe yet' in answer.message
    fed = Fed(node)
    fed.drive(range(2))
    (tmp_path / 'mine.txt').write_text('precious')
    (answer,) = _finished(
        node.map_services.on_save_map(SaveMap.Request(path=str(tmp_path)), SaveMap.Response())
    )
    assert not answer.success and 'mine.txt' in answer.message
    for path in ('', str(tmp_path)):
        answer = node.map_services.on_load_map(LoadMap.Request(path=path), LoadMap.Response())
        assert not answer.success and answer.message
    assert len(fed.path()) == 2  # a map that cannot be loaded costs nothing


def test_everything_over_dds_beside_the_callbacks(
    make: Make, spin_until: Callable[..., bool], tmp_path: Path
) -> None:
    node = make(PoseGraphNode, namespace='car', map_period=0.2, display_period=0.2)
    other = make(PoseGraphNode, namespace='other', publish_tf=False)
    heard: dict[str, list[Any]] = defaultdict(list)
    for kind, topic in (
        (PathMessage, 'path'),
        (PointCloud2, 'map'),
        (MarkerArray, 'loop_markers'),
        (LoopConstraintArray, 'loops'),
    ):
        node.create_subscription(kind, topic, heard[topic].append, qos.LATCHED)
    for step in range(ROUND + 6):
        node.on_keyframe(drive.keyframe(step, DRIFT))
    for pair in [*TRUE_LOOPS]:
        node.on_loop_constraint(drive.loop(*pair))
    node.on_loop_constraint(drive.loop(20, 80, wrong_by_m=8.0))
    # The verdict comes from the solver's process and through the executor.
    assert spin_until([node, other], lambda: not node.map.graph.needs_verdict, timeout_s=30.0)
    statuses = [loop.status for loop in node.map.graph.loops()]
    assert statuses == [LoopStatus.ACCEPTED] * 3 + [LoopStatus.REJECTED_BY_GRAPH]
    assert spin_until(
        [node],
        lambda: (
            heard['map']
            and heard['map'][-1].width > 1000
            and heard['loops']
            and heard['loops'][-1].loops[-1].status == LoopStatus.REJECTED_BY_GRAPH
        ),
        timeout_s=20.0,
    )
    assert heard['loop_markers'][-1].markers[0].action == Marker.ADD
    assert len(heard['path'][-1].poses) == ROUND + 6
    save = other.create_client(SaveMap, '/car/pose_graph/save_map')
    assert spin_until([node, other], save.service_is_ready)
    answer = save.call_async(SaveMap.Request(path=str(tmp_path / 'map')))
    assert spin_until([node, other], answer.done, timeout_s=20.0)
    assert answer.result().success
    load = other.create_client(LoadMap, '/other/pose_graph/load_map')
    assert spin_until([other], load.service_is_ready)
    answer = load.call_async(LoadMap.Request(path=str(tmp_path / 'map')))
    assert spin_until([node, other], answer.done, timeout_s=20.0)
    assert len(other.map) == ROUND + 6


def _finished(coroutine: Any) -> tuple[Any]:
    """Run a coroutine that has nothing to wait for."""
    with pytest.raises(StopIteration) as stopped:
        coroutine.send(None)
    return (stopped.value.value,)
