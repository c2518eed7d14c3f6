"""The Freiburg protocol's pairs, and what a guess is worth to ICP, in a world that is known."""

import numpy as np
import pytest
from evaluation_samples import World, out_and_back

from lcd_common import se3
from lcd_loop_closure.evaluation.icp_pairs import IcpPairsConfig, drawn_pairs, icp_pairs
from lcd_loop_closure.evaluation.initial_guess import compare_guess
from lcd_loop_closure.evaluation.registration_pairs import Band, choose_pairs
from lcd_loop_closure.revisits import RevisitConfig

SETTINGS = IcpPairsConfig(excluded_scans=5, iterations=30)


@pytest.fixture(scope='module')
def world():
    poses = out_and_back(45.0)
    # A third passage, the way of the first.
    third = poses[:15].copy()
    third[:, 1, 3] += 0.5
    return World(np.concatenate([poses, third]))


def test_one_neighbour_is_drawn_for_each_scan_and_level(world):
    match, query, level = drawn_pairs(world.T_world_base, SETTINGS, seed=0)
    assert len(set(zip(query, level, strict=True))) == len(query)
    assert set(level) == {0, 2}
    away = world.T_world_base[match, :3, 3] - world.T_world_base[query, :3, 3]
    assert np.linalg.norm(away, axis=1).max() <= 10.0
    assert (query - match).min() == 6  # the 5 scans before one are left out
    # Every scan of the second passage has a neighbour of the first, the other way.
    assert set(range(21, 30)) <= set(query[level == 2])


def test_poses_off_by_a_metre_are_put_right_and_both_directions_are_as_many(world):
    rng = np.random.default_rng(0)
    rough = world.T_world_base.copy()
    rough[:, :2, 3] += rng.uniform(-0.4, 0.4, (len(rough), 2))
    pairs = icp_pairs(rough, world.cloud, SETTINGS, count=4)
    assert len(pairs) == 8 and pairs.reverse.sum() == 4
    for m, q, T in zip(pairs.match, pairs.query, pairs.T_match_query, strict=True):
        true = se3.inverse(world.T_world_base[m]) @ world.T_world_base[q]
        assert se3.distance(true, T)[0] < 0.05


def test_pairs_that_icp_does_not_confirm_are_left_out(world):
    strict = IcpPairsConfig(excluded_scans=5, iterations=30, min_fitness=1.0)
    pairs = icp_pairs(world.T_world_base, world.cloud, strict, count=2)
    assert len(pairs) == 0 and pairs.T_match_query.shape == (0, 4, 4)


class Truth:
    name = 'truth'

    def __init__(self, world, pairs):
        self._answers = iter(pairs.T_match_query)

    def prepare(self, cloud):
        return cloud

    def register(self, match, query):
        return next(self._answers)


def test_a_right_guess_takes_icp_to_the_right_place(world):
    settings = RevisitConfig(first_scan=15, excluded_scans=5)
    pairs = choose_pairs(world.T_world_base, Band(0.0, 4.0), settings, count=4)
    turned = pairs.reverse
    assert turned.any()
    found = compare_guess(Truth(world, pairs), world.cloud, pairs)
    assert found is not None and found.pairs == 4
    assert found.guided_rmse_m < 0.05 < found.rmse_m
