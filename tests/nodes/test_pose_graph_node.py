"""Feed pose_graph by hand and read what it publishes."""

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from fed_pose_graph import ROUND, TRUE_LOOPS, Fed, Make, errors, odom, second_round
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import Imu, NavSatFix, NavSatStatus
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from lcd_common import se3
from lcd_common.nodes import messages
from lcd_loop_closure.gnss import GnssDatum
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from lcd_loop_closure.nodes.positions_message import positions_from_message
from lcd_msgs.msg import LoopConstraintArray
from lcd_msgs.srv import AddLoop, RemoveLoop

pytestmark = pytest.mark.ros


def test_loops_correct_the_path_and_are_shown(make: Make) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    second_round(fed, [])
    before = errors(fed).max()
    _second_round_loops = [drive.loop(*pair) for pair in TRUE_LOOPS]
    for message in _second_round_loops:
        fed.feed('loop_constraint', message)
    fed.feed('loop_constraint', drive.loop(30, 90, status=LoopStatus.REJECTED_FITNESS))
    fed.refresh()
    assert before > 0.5
    assert errors(fed).max() < 0.25 * before
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
    second_round(fed, TRUE_LOOPS)
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
    fed.feed('odom', odom(0))
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
    second_round(fed, [])
    before = errors(fed).max()
    request = AddLoop.Request(match_id=0, query_id=ROUND)
    request.transform = drive.loop(0, ROUND).transform
    services = fed.node.map_services
    assert services.on_add_loop(request, AddLoop.Response()).success
    assert errors(fed).max() < 0.5 * before
    removed = services.on_remove_loop(
        RemoveLoop.Request(match_id=0, query_id=ROUND), RemoveLoop.Response()
    )
    assert removed.success
    assert errors(fed).max() == pytest.approx(before, rel=0.1)
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
