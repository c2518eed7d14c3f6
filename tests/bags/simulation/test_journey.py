"""Drives revisit as asked, stay on their streets and move as a car can."""

from collections import Counter, defaultdict
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bags.simulation.demonstration import demonstration
from bags.simulation.itinerary import JourneyConfig, Leg
from bags.simulation.journey import Journey
from bags.simulation.lane import lane_m
from bags.simulation.street_map import StreetMap, street_map
from bags.street.town import Ground
from lcd_common import se3
from lcd_loop_closure.revisits import RevisitConfig, count_revisits, true_loops

GROUND = Ground(np.random.default_rng(1))


def drive(seed: int, run: int = 0, **settings: float) -> Journey:
    return Journey(street_map(seed), GROUND, JourneyConfig(**settings), seed, run)


def metre_by_metre(journey: Journey) -> se3.Array:
    """Return poses about 1 m apart, so that shares of poses are shares of the way."""
    time_s = np.arange(0.0, journey.duration_s, 0.02)
    s = journey.travelled(time_s)
    return journey.T_world_base(time_s[np.unique(s.astype(int), return_index=True)[1]])


def revisits(T: se3.Array) -> dict[str, float]:
    """Count how much of a drive revisits by the thesis's rule, and which way."""
    settings = RevisitConfig(excluded_scans=30, first_scan=30)
    found = true_loops(T[:, :3, 3], settings)
    yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    kinds = Counter[str]()
    for i, earlier in enumerate(found):
        if len(earlier):
            turned = np.abs(np.angle(np.exp(1j * (yaw[i] - yaw[earlier]))))
            same = (turned < np.radians(40)).any()
            back = (turned > np.radians(140)).any()
            kinds['same_way' if same else 'reverse' if back else 'crossing'] += 1
    return {kind: count / len(T) for kind, count in kinds.items()}


@pytest.mark.parametrize(
    ('same_way', 'reverse'), [(0.2, 0.1), (0.4, 0.0), (0.0, 0.35), (0.25, 0.25), (0.0, 0.0)]
)
def test_revisits_come_out_as_asked(same_way: float, reverse: float) -> None:
    for seed in (3, 100):
        journey = drive(seed, length=1500.0, same_way=same_way, reverse=reverse)
        assert sum(journey.plan.metres) == pytest.approx(1500.0, abs=12.0)
        assert journey.plan.same_way == pytest.approx(same_way, abs=0.06)
        assert journey.plan.reverse == pytest.approx(reverse, abs=0.06)
        counted = revisits(metre_by_metre(journey))
        # Crossings that are passed in both ways add to one or the other.
        assert counted.get('same_way', 0.0) == pytest.approx(same_way, abs=0.1)
        assert counted.get('reverse', 0.0) == pytest.approx(reverse, abs=0.1)


def cut(one: se3.Array, other: se3.Array) -> bool:
    """Tell whether two straight lines [2 x 2] intersect: each has its ends beside the other."""

    def sides(line: se3.Array, points: se3.Array) -> float:
        along, away = line[1] - line[0], points - line[0]
        return float(np.prod(along[0] * away[:, 1] - along[1] * away[:, 0]))

    return sides(one, other) < 0.0 and sides(other, one) < 0.0


def recounted_crossings(streets: StreetMap, legs: tuple[Leg, ...]) -> float:
    """Recount the share of crossings passed before on other streets, right across."""
    passed: dict[int, list[tuple[set[int], se3.Array]]] = defaultdict(list)
    count = 0
    for leg, following in pairwise(legs):
        if leg.turns_back:
            continue
        lines = [streets.edges[leg.edge].centreline, streets.edges[following.edge].centreline]
        came = lines[0] if leg.forward else lines[0][::-1]
        goes = lines[1] if following.forward else lines[1][::-1]
        # As far from the crossing on all streets, else a long one may pass a short one's end.
        ends = np.array([came[-4] - came[-1], goes[3] - goes[0]])
        ends /= np.linalg.norm(ends, axis=1, keepdims=True)
        node = streets.edges[leg.edge].j if leg.forward else streets.edges[leg.edge].i
        here = {leg.edge, following.edge}
        is_new = all(not here & before for before, _ in passed[node])
        count += is_new and any(cut(ends, line) for _, line in passed[node])
        passed[node].append((here, ends))
    return count / (len(legs) - 1)


def test_the_more_crossings_are_asked_for_the_more_are_passed_again() -> None:
    shares, of_the_way = [], []
    for crossing in (0.0, 0.05, 0.1):
        journeys = [drive(seed, length=1500.0, crossing=crossing) for seed in range(6)]
        for seed, journey in enumerate(journeys):
            recounted = recounted_crossings(street_map(seed), journey.plan.legs)
            assert journey.plan.crossing == pytest.approx(recounted)
        shares.append(np.mean([journey.plan.crossing for journey in journeys]))
        counted = [revisits(metre_by_metre(journey)) for journey in journeys]
        of_the_way.append(np.mean([each.get('crossing', 0.0) for each in counted]))
    assert shares[0] < 0.01 and shares[1] == pytest.approx(0.05, abs=0.015) and shares[2] > 0.065
    assert of_the_way[0] < of_the_way[1] < of_the_way[2]


def test_the_demonstration_shows_streets_again_both_ways() -> None:
    shown = demonstration()
    assert 60.0 < shown.journey.duration_s < 80.0
    plan, counted = shown.journey.plan, revisits(metre_by_metre(shown.journey))
    for share, by_pose in ((plan.same_way, 'same_way'), (plan.reverse, 'reverse')):
        assert share > 0.12 and counted[by_pose] > 0.12
        assert counted[by_pose] == pytest.approx(share, abs=0.05)
    scans = count_revisits(shown.truth().T_world_body)
    assert scans.loops > 0.24 * scans.scans
    assert scans.reverse_share is not None and 0.2 < scans.reverse_share < 0.8


def test_it_is_as_long_as_asked_and_ends_at_rest() -> None:
    journey = drive(3, length=800.0)
    assert journey.travelled(journey.duration_s) == pytest.approx(800.0, abs=12.0)
    ends = journey.travelled(np.array([0.0, 0.2, journey.duration_s - 0.2, journey.duration_s]))
    assert ends[1] - ends[0] < 1e-3 and ends[3] - ends[2] < 1e-3


def test_it_moves_as_a_car_can() -> None:
    journey = drive(5, length=1500.0, same_way=0.0, reverse=0.3, stops=0.5)
    step = 0.02
    T = journey.T_world_base(np.arange(0.0, journey.duration_s, step))
    velocity = np.diff(T[:, :2, 3], axis=0) / step
    acceleration = np.diff(velocity, axis=0) / step
    yaw = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    assert np.linalg.norm(velocity, axis=1).max() < 11.1
    assert np.linalg.norm(acceleration, axis=1).max() < 4.5
    assert np.abs(np.diff(yaw)).max() / step < 0.8
    speed = np.linalg.norm(velocity, axis=1)
    assert (speed > -1e-9).all() and (speed[100:-100] < 0.01).any()  # it stopped on the way
    # It drives ahead, never sideways.
    moving = speed > 0.5
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])[moving]
    assert np.abs(np.angle(np.exp(1j * (heading - yaw[:-1][moving])))).max() < 0.06


def test_it_keeps_right_and_on_the_carriageway() -> None:
    streets = street_map(3)
    journey = drive(3, length=2000.0, lateral=2.0)
    narrowest = min(edge.half_width_m for edge in streets.edges)
    centre = cKDTree(np.concatenate([edge.centreline for edge in streets.edges]))
    away = centre.query(metre_by_metre(journey)[:, :2, 3])[0]
    assert away.max() < max(edge.half_width_m for edge in streets.edges) + 2.0
    assert np.median(away) == pytest.approx(np.mean([lane_m(e) for e in streets.edges]), abs=0.6)
    assert narrowest > 2.0


def test_the_car_stands_on_the_ground() -> None:
    journey = drive(4)
    T = journey.T_world_base(np.linspace(0.0, journey.duration_s, 200))
    np.testing.assert_allclose(T[:, 2, 3], GROUND.height(T[:, :2, 3]))
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0)
    leaning = np.degrees(np.arccos(T[:, 2, 2]))
    assert 0.1 < leaning.mean() < 6.0


def test_runs_drive_the_same_streets_in_their_own_way() -> None:
    first, again, second = drive(3), drive(3), drive(3, run=1)
    at = np.linspace(0.0, 100.0, 50)
    np.testing.assert_array_equal(first.T_world_base(at), again.T_world_base(at))
    assert first.plan.legs == second.plan.legs
    away = cKDTree(first.path.xy).query(second.path.xy)[0]
    assert 0.01 < np.median(away) < 2.0
    assert first.duration_s != second.duration_s
    assert drive(4).plan.legs != first.plan.legs
