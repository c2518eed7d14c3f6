"""The bound of a relative pose by a loop beside it, against the marginal of the whole graph."""

from __future__ import annotations

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.neighbouring_loop import covariance_by_neighbour
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.town_graphs import TownGraph, TownGraphConfig, town_graph


@pytest.fixture(scope='module')
def town() -> TownGraph:
    return town_graph(TownGraphConfig(keyframes=500), 1)


@pytest.fixture(scope='module')
def graph(town: TownGraph) -> PoseGraph:
    graph = PoseGraph()
    for keyframe in town.keyframes():
        graph.add_keyframe(keyframe)
    for loop in town.loops:
        graph.add_loop(loop)
    graph.update()
    return graph


def parts(graph: PoseGraph) -> tuple:
    return graph._ledger, graph._odometry, graph._factors.broken_rows


def test_the_bound_is_no_smaller_than_the_marginal(graph: PoseGraph) -> None:
    loops = [loop.key for loop in graph._ledger]
    assert len(loops) > 20
    for match, query in loops[::5]:
        key = (match + 2, query + 3)
        bound = covariance_by_neighbour(*parts(graph), key, graph._factors.doubt)
        assert bound is not None and se3.is_covariance(bound)
        rows = (graph._odometry.row(i) for i in key)
        marginal = graph._factors.relative_covariance(*rows)
        ratio = np.linalg.eigvals(np.linalg.solve(bound, marginal)).real
        assert ratio.max() < 1.0


def test_on_the_loop_itself_the_bound_is_its_covariance(graph: PoseGraph) -> None:
    loop = next(iter(graph._ledger))
    np.testing.assert_allclose(
        covariance_by_neighbour(*parts(graph), loop.key, lambda loop: 2.0),
        2.0 * loop.covariance,
        rtol=1e-9,
    )


def test_without_a_near_loop_or_across_a_broken_link_there_is_none(graph: PoseGraph) -> None:
    ledger, odometry, _ = parts(graph)
    sure = lambda loop: 1.0  # noqa: E731
    assert covariance_by_neighbour(ledger, odometry, (), (0, 1), sure) is None
    ids = np.array([loop.key[1] for loop in ledger])
    first = int(ids.min())
    key = next(loop.key for loop in ledger if loop.key[1] == first)
    near = (key[0], first + 1)
    assert covariance_by_neighbour(ledger, odometry, (), near, sure) is not None
    if not np.any(ids == first + 1):
        row = odometry.row(first + 1)
        assert covariance_by_neighbour(ledger, odometry, {row}, near, sure) is None
