"""Made-up towns have what their description says."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.town_graphs import (
    TownGraph,
    TownGraphConfig,
    aliased_false_loops,
    random_false_loops,
    town_graph,
)


@pytest.fixture(scope='module')
def town() -> TownGraph:
    return town_graph(TownGraphConfig(keyframes=800), seed=1)


def test_the_same_seed_makes_the_same_town(town: TownGraph) -> None:
    again = town_graph(TownGraphConfig(keyframes=800), seed=1)
    np.testing.assert_array_equal(town.T_world_base, again.T_world_base)
    np.testing.assert_array_equal(town.motions, again.motions)
    other = town_graph(TownGraphConfig(keyframes=800), seed=2)
    assert not np.array_equal(town.motions, other.motions)


def test_true_loops_tie_places_that_are_the_same(town: TownGraph) -> None:
    assert len(town.loops) > 30
    turned = 0
    for loop in town.loops:
        T = se3.inverse(town.T_world_base[loop.match_id]) @ town.T_world_base[loop.query_id]
        assert loop.T_match_query is not None
        metres, radians = se3.distance(T, loop.T_match_query)
        assert metres < 0.4 and radians < 0.04
        assert np.linalg.norm(T[:3, 3]) <= 4.0
        assert loop.query_id - loop.match_id >= 50
        turned += abs(se3.yaw(T)) > 2.5
    assert 0 < turned < len(town.loops)  # same way and reverse


def test_odometry_drifts_as_much_as_a_lidar_s(town: TownGraph) -> None:
    shares = []
    for first in range(0, 750, 25):
        second = first + 50  # 100 m
        truth = se3.inverse(town.T_world_base[first]) @ town.T_world_base[second]
        odometry = se3.inverse(town.T_odom_base[first]) @ town.T_odom_base[second]
        shares.append(np.linalg.norm((truth - odometry)[:3, 3]) / 100.0)
    assert 0.002 < np.mean(shares) < 0.01


def test_wrong_loops_lie_apart_and_aliased_ones_agree(town: TownGraph) -> None:
    T = town.T_world_base
    for loop in (*random_false_loops(town, 20, 0), *aliased_false_loops(town, 15, 0)):
        assert np.linalg.norm(T[loop.match_id, :3, 3] - T[loop.query_id, :3, 3]) >= 15.0
    offsets = []
    for loop in aliased_false_loops(town, 15, 0):
        assert loop.T_match_query is not None
        offsets.append(T[loop.match_id] @ loop.T_match_query @ se3.inverse(T[loop.query_id]))
    for offset in offsets:
        moved = se3.inverse(offsets[0]) @ offset @ T[loop.query_id]
        assert se3.distance(moved, T[loop.query_id])[1] < 0.05
