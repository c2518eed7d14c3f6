"""See on /diagnostics what waits in pose_graph."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticArray
from fed_pose_graph import ROUND, TRUE_LOOPS, Fed, Make, odom, second_round
from sensor_msgs.msg import NavSatFix, NavSatStatus

from lcd_common.nodes import messages
from lcd_loop_closure.map_store import save_map
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

pytestmark = pytest.mark.ros


class Watched(Fed):
    """A node whose diagnostics are heard."""

    def __init__(self, node: PoseGraphNode) -> None:
        super().__init__(node)
        self.arrays: list[DiagnosticArray] = []
        self.lockstep.listen('/diagnostics', self.arrays.append)

    def said(self, what: str) -> str:
        """Return a value of the diagnostics as they are published now."""
        self.node.diagnostics.publish()
        self.settle()
        return {value.key: value.value for value in self.arrays[-1].status[0].values}[what]


def test_loops_wait_for_their_keyframes_and_then_for_the_solver(make: Make) -> None:
    fed = Watched(make(PoseGraphNode, threaded=False))
    fed.feed('keyframe', drive.keyframe(0))
    fed.feed('loop_constraint', drive.loop(0, 2))
    fed.feed('loop_constraint', drive.loop(0, 3))
    assert fed.said('loops waiting for their keyframes') == '2'
    for step in (1, 2):
        fed.feed('keyframe', drive.keyframe(step))
    assert fed.said('loops waiting for their keyframes') == '1'
    assert fed.said('keyframes in the map') == '3'

    fed = Watched(make(PoseGraphNode, namespace='other', threaded=False))
    fed.prefix = '/other/'
    second_round(fed, TRUE_LOOPS)
    assert fed.said('loops waiting for the solver') == '0'
    fed.feed('loop_constraint', drive.loop(20, 80, wrong_by_m=8.0))
    assert fed.said('loops waiting for the solver') == '1'
    assert fed.node._judge.consider(fed.node.map.graph)  # as refresh does when nothing comes
    assert fed.said('loops waiting for the solver') == '0'
    assert len(fed.node.map.graph.loops()) == len(TRUE_LOOPS) + 1


def test_a_session_that_is_not_found_waits(make: Make, tmp_path: Path) -> None:
    fed = Watched(make(PoseGraphNode, threaded=False))
    fed.drive(range(4))
    fed.node.restart(str(save_map(fed.node.map.saved(), tmp_path / 'map')))
    fed.drive(range(10, 13), first_id=0)
    fed.feed('loop_constraint', drive.loop(2, 12))
    assert fed.said('keyframes waiting for their place') == '3'
    assert fed.said('loops waiting for their keyframes') == '1'
    fed.node.map.place(drive.true_pose(0))
    assert fed.said('keyframes waiting for their place') == '0'
    assert fed.said('loops waiting for their keyframes') == '0'
    assert fed.said('keyframes in the map') == '7'


def test_fixes_wait_for_odometry(make: Make) -> None:
    fed = Watched(make(PoseGraphNode, threaded=False, use_gps=True))
    fed.drive(range(2))
    fix = NavSatFix(header=messages.header(drive.stamp(3), 'lidar'), latitude=49.0, longitude=8.4)
    fix.status.status = NavSatStatus.STATUS_FIX
    fix.position_covariance = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 4.0]
    fix.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
    fed.feed('gps/fix', fix)
    assert fed.said('fixes waiting for odometry') == '1'
    fed.feed('odom', odom(2))
    fed.feed('odom', odom(4))
    assert fed.said('fixes waiting for odometry') == '0'


def test_a_solve_under_way_and_what_is_not_shown_yet(
    make: Make, spin_until: Callable[..., bool]
) -> None:
    node = make(PoseGraphNode, display_period=0.0)
    free, shown = threading.Event(), threading.Event()
    solve, show = node._judge._solve, node._display._worker._work

    def slow_solve(snapshot: Any) -> Any:
        free.wait(20.0)
        return solve(snapshot)

    def slow_show(state: Any) -> None:
        shown.set()
        free.wait(20.0)
        show(state)

    node._judge._solve, node._display._worker._work = slow_solve, slow_show

    def values() -> dict[str, str]:
        return {value.key: value.value for value in node.diagnostics.status().values}

    assert values()['solves under way'] == values()['states waiting to be shown'] == '0'
    for step in range(ROUND + 3):
        node.on_keyframe(drive.keyframe(step))
        assert shown.wait(10.0)
    for pair in TRUE_LOOPS[:2]:
        node.on_loop_constraint(drive.loop(*pair))
    assert values()['solves under way'] == values()['states waiting to be shown'] == '1'
    free.set()
    assert spin_until([node], lambda: not node.map.graph.needs_verdict, timeout_s=30.0)
    assert spin_until([node], lambda: values()['solves under way'] == '0')
    assert spin_until([node], lambda: values()['states waiting to be shown'] == '0')
