"""Feed loop_closure by hand and read what it publishes."""

import subprocess
import sys
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from fed_loop_closure import Fed
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.nodes import messages, qos
from lcd_loop_closure.nodes.conversions import keyframe_from_message
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.positions_message import positions_message
from lcd_loop_closure.scan_context import ScanContext
from lcd_msgs.msg import Keyframe
from lcd_msgs.srv import LoadMap

pytestmark = pytest.mark.ros
Make = Callable[..., Any]


def test_keyframes_follow_the_way_and_know_their_motion(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    for step in range(13):
        fed.step(step)
    made = [keyframe_from_message(m) for m in fed.keyframes]
    assert [k.id for k in made] == list(range(len(made)))
    steps = [round((k.stamp_ns - drive.START_NS) / drive.STEP_NS) for k in made]
    assert steps == [0, 3, 6, 9, 12]  # 2 m of chord are a little more than two steps
    for last, this in pairwise(made):
        np.testing.assert_allclose(
            this.T_previous_this, se3.inverse(last.T_odom_base) @ this.T_odom_base, atol=1e-9
        )
        expected = np.zeros((6, 6))
        for k in range(3):
            motion = se3.inverse(drive.true_pose(k)) @ drive.true_pose(k + 1)
            expected = se3.compose_covariance(expected, motion, drive.LINK)
        assert this.motion_covariance is not None
        np.testing.assert_allclose(this.motion_covariance, expected, rtol=1e-5, atol=1e-12)


def test_the_cloud_is_in_the_base_frame_and_described(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    fed.step(0)
    made = keyframe_from_message(fed.keyframes[0])
    whole = messages.cloud_from_message(drive.scan(0)).transformed(drive.T_BASE_LIDAR)
    distance = np.linalg.norm(made.cloud.xyz[:, None] - whole.xyz[None], axis=2).min(axis=1)
    assert 100 < len(made.cloud) < len(whole)
    assert distance.max() < 1e-4  # measured points, not means
    assert made.descriptor_method == 'lcdnet'
    assert np.linalg.norm(made.descriptor) == pytest.approx(1.0, abs=1e-5)
    fed = Fed(make_often(LoopClosureNode, threaded=False, descriptor__method='scan_context'))
    fed.step(0)
    made = keyframe_from_message(fed.keyframes[0])
    assert made.descriptor_method == 'scan_context'
    np.testing.assert_array_equal(made.descriptor, ScanContext().describe(whole))


def test_clouds_wait_for_odometry_and_interpolate(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    fed.lockstep.feed('/odom', drive.odom_message(0))
    between = drive.scan(1, stamp_ns=drive.stamp(0) + drive.STEP_NS // 4)
    fed.lockstep.feed('/points', between)
    assert fed.keyframes == []
    fed.lockstep.feed('/odom', drive.odom_message(1))
    (made,) = fed.keyframes
    np.testing.assert_allclose(
        keyframe_from_message(made).T_odom_base, drive.true_pose(0.25), atol=1e-9
    )


def test_without_odometry_clouds_are_dropped_counted_and_bounded(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False, waiting_clouds=3))
    for step in range(10):
        fed.lockstep.feed('/points', drive.scan(step, count=40))
    assert fed.counted('rejected points: odometry did not come') == 7
    assert fed.keyframes == []


@pytest.mark.parametrize('covariance', [True, False])
def test_odometry_without_covariance_gives_motions_of_unknown_one(
    make_often: Make, covariance: bool
) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    for step in range(4):
        fed.step(step, covariance=covariance)
    known = keyframe_from_message(fed.keyframes[1]).motion_covariance is not None
    assert known is covariance


def test_without_the_transform_nothing_is_guessed(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False), transform=False)
    fed.step(0)
    fed.step(1)
    assert fed.keyframes == []
    assert fed.counted('rejected points: no transform') == 2
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert '/tf_static does not connect base_link with lidar' in status.message
    fed.lockstep.feed('/tf_static', drive.static_transform())
    fed.step(2)
    assert len(fed.keyframes) == 1
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK


def test_broken_input_is_counted_and_survived(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    broken = drive.odom_message(0)
    broken.pose.pose.position.x = float('nan')
    fed.lockstep.feed('/odom', broken)
    assert fed.counted('rejected odom: broken') == 1
    nameless = drive.scan(0)
    nameless.fields[0].name = 'range'
    fed.lockstep.feed('/points', nameless)
    fed.lockstep.feed('/odom', drive.odom_message(0))
    assert fed.counted('rejected points: broken') == 1
    empty = drive.scan(3)
    empty.width, empty.row_step, empty.data = 0, 0, empty.data[:0]
    fed.lockstep.feed('/points', empty)
    fed.lockstep.feed('/odom', drive.odom_message(3))
    assert fed.counted('rejected points: empty') == 1
    fed.lockstep.feed('/graph/keyframes', drive.scan(0))
    assert fed.counted('rejected graph/keyframes: broken') == 1
    fed.step(3)  # the same stamps again
    assert fed.counted('rejected points: duplicate stamp') == 1
    assert fed.counted('rejected odom: duplicate stamp') == 1
    fed.step(6)
    assert len(fed.keyframes) == 1


def test_a_looped_bag_starts_again(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    for _ in range(2):
        for step in range(0, 30, 3):
            fed.step(step)
    assert [m.id for m in fed.keyframes] == list(range(10)) * 2
    assert fed.counted('clock jumps in odom') == 1


def test_a_looped_bag_is_refused_until_reset(make_often: Make) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False, on_time_jump='refuse'))
    for _ in range(2):
        for step in range(0, 30, 3):
            fed.step(step)
    assert [m.id for m in fed.keyframes] == list(range(10))
    assert fed.counted('rejected odom: clock jumped back') == 9
    status = fed.node.diagnostics.status()
    assert status.level == DiagnosticStatus.ERROR
    assert 'refusing input until ~/reset' in status.message
    assert fed.node.on_reset(Trigger.Request(), Trigger.Response()).success
    assert fed.node.diagnostics.status().level == DiagnosticStatus.OK
    fed.step(3)
    assert fed.keyframes[-1].id == 0


def test_a_slow_search_drops_the_oldest_and_no_keyframe(
    make_often: Make, spin_until: Callable[..., bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make_often(LoopClosureNode, waiting_searches=2)
    free, searched, remembered = threading.Event(), [], []

    def slow(job: Any) -> list[Any]:
        (searched if job.search else remembered).append(job.keyframe.id)
        free.wait(20.0)
        return []

    monkeypatch.setattr(node._search, 'run', slow)
    keyframes: list[Keyframe] = []
    node.create_subscription(Keyframe, 'keyframe', keyframes.append, qos.RELIABLE)
    node._transforms.on_tf_static(drive.static_transform())
    for count, step in enumerate(range(0, 24, 3), start=1):
        node.on_points(drive.scan(step))
        node.on_odom(drive.odom_message(step))
        assert spin_until([node], lambda n=count: len(keyframes) == n)
    assert [m.id for m in keyframes] == list(range(8))  # all are out while the first is searched
    assert searched == [0]
    assert node.diagnostics.counted('dropped searches: machine too slow') == 5
    free.set()
    assert spin_until([node], lambda: searched == [0, 6, 7])
    assert remembered == [1, 2, 3, 4, 5]  # in their order, before the next search


def test_scans_that_wait_to_become_keyframes_are_in_the_diagnostics(
    make_often: Make, spin_until: Callable[..., bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make_often(LoopClosureNode, descriptor__method='scan_context')
    free, begun = threading.Event(), threading.Event()

    def slow(*given: Any) -> None:
        begun.set()
        free.wait(20.0)

    monkeypatch.setattr(node._search, 'keyframe', slow)
    heard: list[DiagnosticArray] = []
    node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, qos.RELIABLE)

    def wait(number: int) -> bool:
        node.diagnostics.publish()
        values = {v.key: v.value for m in heard[-1:] for v in m.status[0].values}
        return values.get('scans waiting to become keyframes') == str(number)

    node._transforms.on_tf_static(drive.static_transform())
    for step in range(0, 24, 3):
        node.on_points(drive.scan(step))
        node.on_odom(drive.odom_message(step))
        assert begun.wait(10.0)
    assert spin_until([node], lambda: wait(5))  # as many as there is room for
    assert node.diagnostics.counted('dropped keyframes: queue full') == 2
    free.set()
    assert spin_until([node], lambda: wait(0))


def test_positions_of_the_graph_reach_the_search(
    make_often: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    jobs: list[Any] = []

    def note(job: Any) -> list[Any]:
        jobs.append(job)
        return []

    monkeypatch.setattr(fed.node._search, 'run', note)
    poses = np.array([drive.true_pose(k) for k in range(4)])
    fed.lockstep.feed('/graph/keyframes', positions_message(np.arange(4), poses, 1, 'map'))
    fed.step(0)
    np.testing.assert_array_equal(jobs[0].graph.ids, np.arange(4))
    np.testing.assert_allclose(jobs[0].graph.xyz, poses[:, :3, 3], atol=1e-6)
    np.testing.assert_array_equal(jobs[0].sensor_origin, drive.T_BASE_LIDAR[:3, 3])


def test_namespaces_remaps_and_several_in_one_process(make_often: Make) -> None:
    remap = ['--ros-args', '-r', 'points:=/velodyne_points']
    left = Fed(make_often(LoopClosureNode, namespace='left', threaded=False), '/left/')
    right = make_often(LoopClosureNode, namespace='right', cli_args=remap, threaded=False)
    left.step(0)
    assert len(left.keyframes) == 1
    assert left.keyframes[0].header.frame_id == 'odom'
    assert left.keyframes[0].child_frame_id == 'base_link'
    names = {s.topic_name for s in right.subscriptions}
    assert {'/velodyne_points', '/right/odom', '/right/graph/keyframes'} <= names
    assert {'/right/keyframe', '/right/loop_constraint'} <= {p.topic_name for p in right.publishers}


def test_the_reliable_parameter_asks_for_every_cloud(make_often: Make) -> None:
    for reliable, profile in ((False, qos.SENSOR), (True, qos.SENSOR_RELIABLE)):
        node = make_often(LoopClosureNode, threaded=False, reliable_points=reliable)
        (points,) = [s for s in node.subscriptions if s.topic_name == '/points']
        assert points.msg_type is PointCloud2
        assert points.qos_profile.reliability == profile.reliability


def test_loading_what_is_no_map_changes_nothing(make_often: Make, tmp_path: Path) -> None:
    fed = Fed(make_often(LoopClosureNode, threaded=False))
    fed.step(0)
    answer = fed.node.on_load_map(LoadMap.Request(path=str(tmp_path)), LoadMap.Response())
    assert not answer.success
    assert 'not a saved map' in answer.message
    fed.step(3)
    assert [m.id for m in fed.keyframes] == [0, 1]


def test_a_wrong_parameter_is_named(make_often: Make) -> None:
    with pytest.raises(ConfigError, match='on_time_jump must be one of restart, refuse'):
        make_often(LoopClosureNode, on_time_jump='panic')
    with pytest.raises(ConfigError, match=r'keyframes\.distance'):
        make_often(LoopClosureNode, keyframes__distance=0.0)


def test_a_missing_parameter_file_is_named_without_a_traceback() -> None:
    code = 'from lcd_loop_closure.nodes.loop_closure_node import main; raise SystemExit(main())'
    words = ['--ros-args', '--params-file', 'no/such.yaml']
    run = subprocess.run(
        [sys.executable, '-c', code, *words], capture_output=True, text=True, check=False
    )
    assert run.returncode == 1
    last = run.stderr.splitlines()[-1]  # rcl has its own word before
    assert last.startswith('error: ') and 'no/such.yaml' in last
    assert 'Traceback' not in run.stderr


@pytest.mark.parametrize('node', ['loop_closure', 'pose_graph'])
def test_help_names_topics_and_services(node: str) -> None:
    code = f'from lcd_loop_closure.nodes.{node}_node import main; raise SystemExit(main())'
    run = subprocess.run(
        [sys.executable, '-c', code, '--help'], capture_output=True, text=True, check=True
    )
    for word in ('Subscribes', 'Publishes', 'Services', 'keyframe', '~/load_map', 'ros2 run'):
        assert word in run.stdout
