import numpy as np
import pytest
from simulated_street import pairs_apart, relative, turned, view

from lcd_common import se3
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pair_registration import PairConfig, PairRegistration


def compare(match_xyz, query_xyz, settings=None):
    pairs = PairRegistration(settings)
    return pairs.compare(pairs.prepare(match_xyz), pairs.prepare(query_xyz))


@pytest.mark.parametrize('yaw', [0.0, 1.3, np.pi])
@pytest.mark.parametrize(('low', 'high'), [(0.5, 4), (4, 10)])
def test_the_same_place_is_accepted_with_its_exact_pose(low, high, yaw):
    pairs = pairs_apart(low, high)
    for at in np.linspace(0, len(pairs) - 1, 2).astype(int):
        match, query = view(pairs[at][0]), turned(view(pairs[at][1]), yaw)
        result = compare(match.reduced.xyz, query.reduced.xyz)
        assert result.status is LoopStatus.ACCEPTED, result.reason
        metres, radians = se3.distance(relative(match, query), result.T_match_query)
        assert metres < 0.05 and np.degrees(radians) < 0.1
        assert se3.is_covariance(result.covariance)


def test_other_places_of_the_town_are_rejected():
    pairs = pairs_apart(50, 200)
    for at in np.linspace(0, len(pairs) - 1, 8).astype(int):
        match, query = (view(i).reduced.xyz for i in pairs[at])
        result = compare(match, query)
        assert result.status is not LoopStatus.ACCEPTED
        assert result.covariance is None
        assert any(character.isdigit() for character in result.reason)


def test_a_street_that_repeats_itself_is_ambiguous():
    """Identical houses every 12 m: the next house fits nearly as well as the right one."""
    rng = np.random.default_rng(0)

    def sweep(first_house):
        y, z = np.meshgrid(np.arange(0, 7, 0.4), np.arange(0, 5, 0.4))
        front = np.column_stack([y.ravel(), np.zeros(y.size), z.ravel()])
        side = np.column_stack([np.zeros(y.size), y.ravel(), z.ravel()])
        houses = [
            part * [1, sign, 1] + [12.0 * k - 6.0, sign * 9.0, 0]
            for k in range(-5, 6)
            for sign in (-1, 1)
            for part in (front, side)
        ]
        ground = np.column_stack([rng.uniform(-60, 60, (3000, 2)), np.zeros(3000)])
        xyz = np.vstack([*houses, ground]) + np.array([first_house, 0, 0])
        return (xyz + rng.normal(0, 0.02, xyz.shape)).astype(np.float32)

    result = compare(sweep(0.0), sweep(5.0))
    assert result.status is LoopStatus.REJECTED_REGISTRATION
    assert 'another pose fits nearly as well' in result.reason


@pytest.mark.parametrize('count', [0, 1, 8])
def test_hardly_any_points_are_no_place(count):
    xyz = view(3).reduced.xyz
    for match, query in ((xyz[:count], xyz), (xyz, xyz[:count])):
        assert compare(match, query).status is LoopStatus.REJECTED_REGISTRATION


def test_early_exits_say_value_and_limit():
    match, query = view(3).reduced.xyz, view(60).reduced.xyz
    result = compare(match, query, PairConfig(min_bev_score=1.0))
    assert result.status is LoopStatus.REJECTED_REGISTRATION
    assert 'views from above correlate' in result.reason and 'below 1' in result.reason
    result = compare(match, query, PairConfig(min_rough_fitness=1.0))
    assert result.status is LoopStatus.REJECTED_FITNESS
    assert 'roughly aligned' in result.reason
