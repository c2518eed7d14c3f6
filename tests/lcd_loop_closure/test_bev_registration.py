import numpy as np
import pytest
from simulated_street import pairs_apart, relative, turned, view

from lcd_common import se3
from lcd_loop_closure.bev_registration import BevConfig, BevRegistration


def columns(count=150, seed=0):
    """Poles, walls and ground around a vehicle: points [N x 3]."""
    rng = np.random.default_rng(seed)
    foot = rng.uniform(-50, 50, (count, 2))
    poles = np.repeat(np.column_stack([foot, np.zeros(count)]), 8, axis=0)
    poles[:, 2] = np.tile(np.linspace(0.0, 3.0, 8), count)
    ground = np.column_stack([rng.uniform(-50, 50, (4000, 2)), np.zeros(4000)])
    return np.vstack([poles, ground])


def best(registration, match, query):
    query_view = registration.view(query)
    spectra = registration.spectra(query_view)
    return registration.search(registration.view(match), spectra, query_view)


@pytest.mark.parametrize('yaw_deg', [0.0, 44.0, 179.0, -91.5])
@pytest.mark.parametrize('shift', [(0.0, 0.0), (11.0, -7.0), (-30.0, 4.4)])
def test_any_yaw_and_offset_is_found(yaw_deg, shift):
    match = columns()
    T_match_query = se3.rotation_z(np.radians(yaw_deg))
    T_match_query[:3, 3] = *shift, 0.7
    query = se3.transform_points(se3.inverse(T_match_query), match)
    found = best(BevRegistration(), match, query)[0]
    metres, radians = se3.distance(T_match_query, found.T_match_query)
    assert metres < 0.5 and np.degrees(radians) < 1.0
    assert found.T_match_query[2, 3] == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize(('low', 'high'), [(0.5, 4), (4, 10), (10, 15)])
def test_revisits_of_a_street_same_way_and_reverse(low, high):
    registration = BevRegistration()
    pairs = pairs_apart(low, high)
    for number, at in enumerate(np.linspace(0, len(pairs) - 1, 4).astype(int)):
        match, query = (view(i) for i in pairs[at])
        query = turned(query, np.pi * (number % 2))
        T = best(registration, match.reduced.xyz, query.reduced.xyz)[0].T_match_query
        metres, radians = se3.distance(relative(match, query), T)
        assert metres < 1.5 and np.degrees(radians) < 4.0


def test_different_places_score_lower_than_the_same_place():
    registration = BevRegistration()
    i, j = pairs_apart(0.5, 4)[100]
    same = best(registration, view(i).reduced.xyz, view(j).reduced.xyz)
    k, m = pairs_apart(70, 90)[500]
    other = best(registration, view(k).reduced.xyz, view(m).reduced.xyz)
    assert same[0].score > 0.5 > 0.4 > other[0].score
    assert same[1].score < 0.7 * same[0].score


def test_hypotheses_are_distinct_and_sorted():
    found = best(BevRegistration(BevConfig(hypotheses=4)), columns(), columns())
    assert len(found) == 4
    assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
    for i, a in enumerate(found):
        for b in found[:i]:
            metres, radians = se3.distance(a.T_match_query, b.T_match_query)
            assert metres > 1.0 or np.degrees(radians) > 4.0


def test_the_same_clouds_give_the_same_answer():
    match, query = view(12).reduced.xyz, view(320).reduced.xyz
    first, second = (best(BevRegistration(), match, query) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.score == b.score and np.array_equal(a.T_match_query, b.T_match_query)


@pytest.mark.parametrize('xyz', [np.empty((0, 3)), columns()[150 * 8 :]])
def test_nothing_on_the_ground_gives_no_answer(xyz):
    registration = BevRegistration()
    assert best(registration, xyz, columns()) == []
    assert best(registration, columns(), xyz) == []
