"""Drive a block with place recognition beside the other nodes, and be found in its map later."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from bags.nodes.lockstep import LockStep
from bags.street import StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from bags.street.route import Route
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides
from lcd_loop_closure.map_store import load_map, save_map
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode
from uncertain_place_recognition.place import Judgement

pytestmark = pytest.mark.ros


def _block() -> StreetDrive:
    route = Route(speed=16.0, corner_radius=8.0).through(
        [(-20, 0), (50, 0), (50, 40), (0, 40), (0, 0), (50, 0)]
    )
    coarse = LidarConfig(columns=240, rate=5.0)  # seconds, not minutes
    return StreetDrive(route, StreetConfig(imu_rate=0.0, gnss_rate=0.0), coarse)


class Doubting:
    """Judge that believes nothing at all, or all."""

    metric, matches, spacing_m = 'cosine', 5, None

    def __init__(self, believes: bool) -> None:
        self._believes = believes

    def reset(self) -> None:
        """Nothing is remembered."""

    def judge(self, neighbours: Any, positions: Any, uncertainty: float, size: int) -> Judgement:
        """Return the same of every match."""
        return Judgement(0.01 if self._believes else 0.9, self._believes, None)


@dataclass
class Suite:
    """Four nodes in lock-step and what they said."""

    loop_closure: LoopClosureNode
    pose_graph: PoseGraphNode
    places: PlaceRecognitionNode
    lockstep: LockStep
    said: dict[str, list[Any]]


@contextmanager
def _suite(
    small_weights: Path, graph: str = '', places: str = '', **options: Any
) -> Iterator[Suite]:
    inside = {'threaded': False}
    search = {'detector__by_descriptor': not graph, 'detector__by_radius': False}
    nodes = (
        LidarOdometryNode(parameter_overrides=overrides(threads=1, **inside)),
        LoopClosureNode(
            parameter_overrides=overrides(
                map=graph,
                gate__use=True,
                keyframes__distance=5.0,
                descriptor__method='scan_context',
                **search,
                **inside,
            )
        ),
        PoseGraphNode(parameter_overrides=overrides(map=graph, **inside)),
        PlaceRecognitionNode(
            parameter_overrides=overrides(
                weights=str(small_weights),
                follow='keyframes',
                map=places,
                relocalize=bool(places),
                recognizer__delay=3,
                places__distance=0.1,
                **options,
                **inside,
            )
        ),
    )
    suite = Suite(*nodes[1:], LockStep(nodes), {})
    for topic in ('place_matches', 'loop_constraint', 'initialpose', 'keyframe'):
        heard = suite.said.setdefault(topic, [])
        suite.lockstep.listen('/' + topic, heard.append)
    try:
        yield suite
    finally:
        for node in nodes:
            node.destroy_node()


@dataclass(frozen=True)
class Driven:
    """What is left of a drive."""

    graph: Path
    places: Path


@pytest.fixture(scope='module')
def driven(ros: None, small_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Driven:
    """Drive the block once, with a place recognition that believes itself."""
    folder = tmp_path_factory.mktemp('driven')
    with _suite(small_weights) as suite:
        suite.places.recognizer._judge = Doubting(True)
        suite.lockstep.run(_block(), progress=False)
        keyframes = [m.id for m in suite.said['keyframe']]
        places = suite.places.recognizer.places()
        assert [place.id for place in places] == keyframes
        assert [messages.stamp_ns(m.header.stamp) for m in suite.said['place_matches']] == [
            place.stamp_ns for place in places
        ]
        loops = [m for m in suite.said['loop_constraint'] if m.status == m.ACCEPTED]
        assert loops
        # Places lie where the pose graph has the keyframes.
        saved = suite.pose_graph.map.saved()
        ours = np.array([place.T_map_base[:3, 3] for place in places])
        np.testing.assert_allclose(ours, saved.graph.T_map_base[:, :3, 3], atol=0.06)
        return Driven(
            save_map(saved, folder / 'graph'), suite.places.recognizer.save(folder / 'places')
        )


def test_what_place_recognition_rejects_is_not_registered(
    small_weights: Path, driven: Driven
) -> None:
    with _suite(small_weights) as suite:
        suite.places.recognizer._judge = Doubting(False)
        suite.lockstep.run(_block(), progress=False)
        loops = suite.said['loop_constraint']
        assert loops
        assert all(m.status in (m.REJECTED_UNCERTAIN, m.REJECTED_DESCRIPTOR) for m in loops)
        uncertain = [m for m in loops if m.status == m.REJECTED_UNCERTAIN]
        assert uncertain and all(np.isnan(m.fitness) for m in uncertain)
        assert '90% likely to be wrong' in uncertain[0].reason
        counted = suite.loop_closure.diagnostics.counted
        assert counted('loops rejected_uncertain') == len(uncertain)
        assert counted('keyframes searched without an answer of place recognition') == 0


def test_a_kidnapped_vehicle_is_found_in_the_saved_map(small_weights: Path, driven: Driven) -> None:
    """Start on another street with an odometry at zero; loop closure finds no loop by itself."""
    truth = _block().truth()
    assert truth is not None
    with _suite(small_weights, str(driven.graph), str(driven.places)) as suite:
        count = len(load_map(driven.graph).graph)
        suite.lockstep.run(_block(), start_s=5.6, duration_s=4.8, progress=False)
        assert suite.said['loop_constraint'] == []
        (pose,) = suite.said['initialpose']
        online = suite.pose_graph.map
        assert online.located and len(online) > count
        stamp_ns = messages.stamp_ns(pose.header.stamp)
        T_map_base, covariance = messages.from_pose_with_covariance(pose.pose)
        assert covariance is not None
        # The map begins where the truth does; it is bent a little where no loop held it.
        T_map_truth = online.graph.snapshot().T_map_base[0] @ se3.inverse(truth.T_world_body[0])
        metres, radians = se3.distance(T_map_base, T_map_truth @ truth.at(stamp_ns))
        assert metres < 0.5 and radians < 0.05
        # And the places grow on, with the numbers of the new keyframes.
        new = [place for place in suite.places.recognizer.places() if place.id >= count]
        assert len(new) >= 3
        last = online.graph.snapshot()
        at = {int(i): T for i, T in zip(last.ids, last.T_map_base, strict=True)}
        for place in new[:-1]:
            np.testing.assert_allclose(place.T_map_base[:3, 3], at[place.id][:3, 3], atol=0.1)
