"""Save, load and go on in maps of pose_graph, and run it over DDS."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from fed_pose_graph import DRIFT, ROUND, TRUE_LOOPS, Fed, Make, odom, second_round
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.map_store import load_map
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from lcd_msgs.msg import LoopConstraintArray
from lcd_msgs.srv import LoadMap, SaveMap

pytestmark = pytest.mark.ros


def test_a_map_is_saved_and_gone_on_in(make: Make, tmp_path: Path) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    second_round(fed, TRUE_LOOPS)
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
    later.feed('odom', odom(0))
    assert later.heard['tf'] == []  # nobody knows yet where odometry starts
    later.feed('keyframe', drive.keyframe(0))
    assert later.counted('rejected keyframe: other session') == 1
    assert 'load it in loop_closure too' in later.node.diagnostics.status().message
    later.drive(range(1, 6), first_id=count)
    assert later.node.diagnostics.status().level == DiagnosticStatus.WARN
    for step in (2, 4):
        later.feed('loop_constraint', drive.loop(step, step, query_id=count + step))
    assert later.node.diagnostics.status().level == DiagnosticStatus.OK
    later.feed('odom', odom(6))
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


def test_an_initial_pose_belongs_to_its_stamp(make: Make, tmp_path: Path) -> None:
    fed = Fed(make(PoseGraphNode, threaded=False))
    fed.drive(range(4))
    _finished(
        fed.node.map_services.on_save_map(
            SaveMap.Request(path=str(tmp_path / 'map')), SaveMap.Response()
        )
    )
    fed.node.map_services.on_load_map(
        LoadMap.Request(path=str(tmp_path / 'map')), LoadMap.Response()
    )
    fed.drive(range(10, 14), first_id=0)
    pose = PoseWithCovarianceStamped(header=messages.header(drive.stamp(11), 'map'))
    pose.pose.pose = messages.pose_message(drive.true_pose(11))  # where it was two steps ago
    fed.feed('initialpose', pose)
    np.testing.assert_allclose(fed.path()[-1], drive.true_pose(13), atol=1e-6)


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
