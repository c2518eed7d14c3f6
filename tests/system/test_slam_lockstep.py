"""Drive a block through all three nodes: every message twice the same, and a map to return to."""

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from nav_msgs.msg import Odometry

from bags.nodes.lockstep import LockStep
from bags.street import StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from bags.street.route import Route
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.map_store import load_map, save_map
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

pytestmark = pytest.mark.ros
TOPICS = (
    '/odom', '/tf', '/keyframe', '/loop_constraint', '/path', '/pose', '/graph/keyframes',
    '/loops', '/loop_markers',
)  # fmt: skip
START = [(-20, 0), (50, 0), (50, 40), (0, 40), (0, 0), (50, 0)]


def _block() -> StreetDrive:
    route = Route(speed=10.0, corner_radius=8.0).through(START)
    coarse = LidarConfig(columns=240, rate=5.0)  # seconds, not minutes
    return StreetDrive(route, StreetConfig(imu_rate=0.0, gnss_rate=0.0), coarse)


class Drifting:
    """Stand for a worse odometry: bend what lidar_odometry says, and say by how much it may be."""

    def __init__(self, lockstep: LockStep) -> None:
        self._lockstep = lockstep
        self._last = self._bent = np.eye(4)
        self._covariance = 1e-9 * np.eye(6)
        lockstep.listen('/good_odom', self.on_odom)

    def on_odom(self, message: Odometry) -> None:
        """Feed the bent odometry on /odom."""
        T = messages.transform_from_pose(message.pose.pose)
        motion = se3.inverse(self._last) @ T
        metres = float(np.linalg.norm(motion[:3, 3]))
        motion = motion @ se3.exp([0.01 * metres, 0, 0, 0, 0, 1e-3 * metres])
        noise = np.repeat([(0.02 * metres) ** 2 + 1e-6, (2e-3 * metres) ** 2 + 1e-8], 3)
        self._covariance = se3.compose_covariance(self._covariance, motion, np.diag(noise))
        self._last, self._bent = T, self._bent @ motion
        bent = Odometry(header=message.header, child_frame_id=message.child_frame_id)
        bent.pose = messages.pose_with_covariance(self._bent, self._covariance)
        self._lockstep.feed('/odom', bent)


@dataclass
class Slam:
    """Three nodes in lock-step, and a digest of all bytes on each topic."""

    odometry: LidarOdometryNode
    loop_closure: LoopClosureNode
    pose_graph: PoseGraphNode
    lockstep: LockStep
    digests: dict[str, Any]
    counts: dict[str, int]

    def run(self, drive: StreetDrive, **options: float) -> None:
        """Drive, and let the clock run on so that all that was held back comes out."""
        self.lockstep.run(drive, progress=False, **options)
        end = self.pose_graph.map.graph.stamps_ns[-1] if len(self.pose_graph.map) else 0
        for second in range(1, 4):
            self.lockstep.set_time(int(end) + second * 10**9)


@contextmanager
def _slam(beside: bool = False, **parameters: object) -> Iterator[Slam]:
    inside = {'threaded': False}
    remap = ['--ros-args', '-r', 'odom:=good_odom']
    sparse = {'keyframes__distance': 5.0}
    nodes = (
        LidarOdometryNode(
            cli_args=remap, parameter_overrides=overrides(threads=1, publish_tf=False, **inside)
        ),
        LoopClosureNode(
            parameter_overrides=overrides(beside=beside, **inside, **sparse, **parameters)
        ),
        PoseGraphNode(parameter_overrides=overrides(**inside, **parameters)),
    )
    slam = Slam(*nodes, LockStep(nodes), defaultdict(hashlib.sha256), defaultdict(int))

    def digest(topic: str) -> Callable[[bytes], None]:
        def note(data: bytes) -> None:
            slam.digests[topic].update(data)
            slam.counts[topic] += 1

        return note

    Drifting(slam.lockstep)
    for topic in TOPICS:
        slam.lockstep.listen(topic, digest(topic), raw=True)
    try:
        yield slam
    finally:
        for node in nodes:
            node.destroy_node()


@dataclass(frozen=True)
class Driven:
    """What is left of a drive."""

    keyframes: Trajectory
    odometry: Trajectory
    accepted: frozenset[tuple[int, int]]
    digests: dict[str, str]
    counts: dict[str, int]
    map_folder: Path


def _driven(folder: Path, beside: bool = False) -> Driven:
    with _slam(beside) as slam:
        slam.run(_block())
        saved = slam.pose_graph.map.saved()
        loops = slam.pose_graph.map.graph.loops()
        return Driven(
            Trajectory(saved.graph.stamps_ns, saved.graph.T_map_base),
            Trajectory(saved.graph.stamps_ns, saved.graph.T_odom_base),
            frozenset(
                (loop.match_id, loop.query_id)
                for loop in loops
                if loop.status is LoopStatus.ACCEPTED
            ),
            {topic: digest.hexdigest() for topic, digest in slam.digests.items()},
            dict(slam.counts),
            save_map(saved, folder),
        )


@pytest.fixture(scope='module')
def first(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    return _driven(tmp_path_factory.mktemp('first') / 'map')


def _ate_m(estimate: Trajectory) -> float:
    """Return evo's absolute trajectory error after alignment, metres."""
    truth = _block().truth()
    assert truth is not None

    def evo(trajectory: Trajectory) -> PoseTrajectory3D:
        return PoseTrajectory3D(
            poses_se3=list(trajectory.T_world_body), timestamps=trajectory.stamps_ns * 1e-9
        )

    reference, ours = sync.associate_trajectories(evo(truth), evo(estimate), max_diff=0.001)
    ours.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, ours))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def test_loops_make_the_trajectory_better(first: Driven) -> None:
    assert len(first.accepted) >= 3
    before, after = _ate_m(first.odometry), _ate_m(first.keyframes)
    assert before > 0.5
    assert after < 0.3 * before
    for topic in TOPICS:
        assert first.counts[topic] > 0, topic


def test_a_second_run_publishes_the_same_bytes(first: Driven, tmp_path: Path) -> None:
    second = _driven(tmp_path / 'map')
    assert second.counts == first.counts
    assert {t for t in TOPICS if first.digests[t] != second.digests[t]} == set()
    for path in first.map_folder.rglob('*.*'):
        other = second.map_folder / path.relative_to(first.map_folder)
        assert path.read_bytes() == other.read_bytes(), path.name


def test_a_search_beside_repeats_and_finds_the_same_loops(first: Driven, tmp_path: Path) -> None:
    beside = _driven(tmp_path / 'one', beside=True)
    again = _driven(tmp_path / 'two', beside=True)
    assert again.counts == beside.counts
    assert {t for t in TOPICS if beside.digests[t] != again.digests[t]} == set()
    assert beside.digests['/odom'] == first.digests['/odom']
    assert beside.counts['/keyframe'] == first.counts['/keyframe']  # the last one too
    # The graph of one keyframe earlier may offer another neighbour: the same returns, not pairs.
    queries = [{query for _, query in driven.accepted} for driven in (beside, first)]
    assert queries[0] == queries[1]
    moved = np.linalg.norm(beside.keyframes.positions - first.keyframes.positions, axis=1)
    assert moved.max() < 0.1
    assert _ate_m(beside.keyframes) < 0.3 * _ate_m(beside.odometry)


def test_a_later_drive_finds_itself_in_the_saved_map(first: Driven) -> None:
    """Start on another street, a while later, with an odometry that begins at zero."""
    truth = _block().truth()
    assert truth is not None
    with _slam(map=str(first.map_folder)) as slam:
        count = len(load_map(first.map_folder).graph)
        slam.run(_block(), start_s=9.0, duration_s=8.0)
        online = slam.pose_graph.map
        assert online.located
        assert len(online) > count
        snapshot = online.graph.snapshot()
        # The map is bent where no loop held it: measure the session against the map beside it.
        true = np.array([truth.at(int(stamp)) for stamp in snapshot.stamps_ns])
        compared = 0
        for row in range(count, len(snapshot)):
            away = np.linalg.norm(true[:count, :3, 3] - true[row, :3, 3], axis=1)
            near = int(away.argmin())
            if away[near] < 4.0:
                expected = se3.inverse(true[near]) @ true[row]
                found = se3.inverse(snapshot.T_map_base[near]) @ snapshot.T_map_base[row]
                metres, radians = se3.distance(expected, found)
                assert metres < 0.3 and radians < 0.03
                compared += 1
        assert compared >= 5
        moved = snapshot.T_map_base[:count, :3, 3] - first.keyframes.positions
        assert np.abs(moved).max() < 0.3
        assert slam.counts['/pose'] > 0
