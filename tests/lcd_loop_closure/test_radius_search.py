import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.radius_search import GraphPositions, RadiusSearch, RadiusSearchConfig

NOTHING = PointCloud(np.empty((0, 3), np.float32))


def square(steps_per_side=15, step_m=2.0, drift=0.004):
    """Twice around a square: true poses and those by an odometry that turns a little too much."""
    turn = se3.exp([0, 0, 0, 0, 0, np.pi / 2])
    T_true, T_odom = [np.eye(4)], [np.eye(4)]
    for i in range(1, 8 * steps_per_side + 1):
        step = se3.exp([step_m, 0, 0, 0, 0, 0])
        if i % steps_per_side == 0:
            step = step @ turn
        T_true.append(T_true[-1] @ step)
        T_odom.append(T_odom[-1] @ step @ se3.exp([0, 0, 0, 0, 0, drift]))
    return np.array(T_true), np.array(T_odom)


def keyframes_of(T_odom):
    return {
        i: Keyframe(i, i, T, np.eye(4) if i == 0 else se3.inverse(T_odom[i - 1]) @ T, None, NOTHING)
        for i, T in enumerate(T_odom)
    }


def test_without_a_graph_odometry_is_the_estimate():
    T_true, _ = square()
    keyframes = keyframes_of(T_true)
    found = RadiusSearch(RadiusSearchConfig(radius=5.0)).nearest(
        keyframes[65], keyframes, range(50), None, 10
    )
    away = np.linalg.norm(T_true[:50, :3, 3] - T_true[65, :3, 3], axis=1)
    assert {near.id for near in found} == set(np.flatnonzero(away <= 5.0))
    assert [near.distance_m for near in found] == sorted(near.distance_m for near in found)
    for near in found:
        np.testing.assert_allclose(
            near.T_match_query, se3.inverse(T_true[near.id]) @ T_true[65], atol=1e-9
        )


def test_positions_of_the_graph_correct_what_odometry_got_wrong():
    T_true, T_odom = square()
    keyframes = keyframes_of(T_odom)
    query = 119
    # The graph does not hold the newest keyframes yet, and its map is turned against odometry.
    T_map_true = se3.from_rotation_translation(se3.rotation_z(2.0)[:3, :3], [100.0, -50.0, 3.0])
    known = np.arange(116)
    graph = GraphPositions(known, (T_map_true @ T_true[:116])[:, :3, 3])
    search = RadiusSearch(RadiusSearchConfig(radius=6.0))
    found = search.nearest(keyframes[query], keyframes, range(80), graph, 3)
    assert found[0].id == 59
    T_match_query = se3.inverse(T_true[59]) @ T_true[query]
    metres, radians = se3.distance(T_match_query, found[0].T_match_query)
    assert metres < 0.3 and np.degrees(radians) < 3.0
    by_odometry = se3.inverse(T_odom[59]) @ T_odom[query]
    assert se3.distance(T_match_query, by_odometry)[0] > 4.0


def test_only_eligible_keyframes_are_found():
    keyframes = keyframes_of(square()[0])
    search = RadiusSearch(RadiusSearchConfig(radius=1e6))
    assert {n.id for n in search.nearest(keyframes[100], keyframes, [3, 8], None, 9)} == {3, 8}
    assert search.nearest(keyframes[100], keyframes, [], None, 9) == []
    nowhere = GraphPositions(np.empty(0, np.int64), np.empty((0, 3)))
    assert search.nearest(keyframes[100], keyframes, [3, 8], nowhere, 9) == []


def test_a_standing_vehicle_has_no_path_to_align():
    T = np.tile(np.eye(4), (30, 1, 1))
    keyframes = keyframes_of(T)
    graph = GraphPositions(np.arange(30), np.tile([7.0, 8.0, 9.0], (30, 1)))
    (near,) = RadiusSearch().nearest(keyframes[29], keyframes, [0], graph, 1)
    np.testing.assert_allclose(near.T_match_query, np.eye(4), atol=1e-12)


def test_positions_must_fit_their_ids():
    with pytest.raises(DataError, match='3 keyframe ids need as many positions'):
        GraphPositions(np.arange(3), np.zeros((2, 3)))
