"""Drives revisit as asked, stay on their streets and move as a car can."""

from collections import Counter

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bags.simulation.itinerary import JourneyConfig, itinerary
from bags.simulation.journey import Journey
from bags.simulation.path import lane_m
from bags.simulation.street_map import street_map
from bags.street.town import Ground
from lcd_common import se3
from lcd_loop_closure.revisits import RevisitConfig, true_loops

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
        assert journey.plan.same_way == pytest.approx(same_way, abs=0.06)
        assert journey.plan.reverse == pytest.approx(reverse, abs=0.06)
        counted = revisits(metre_by_metre(journey))
        # Crossings that are passed in both ways add to one or the other.
        assert counted.get('same_way', 0.0) == pytest.approx(same_way, abs=0.1)
        assert counted.get('reverse', 0.0) == pytest.approx(reverse, abs=0.1)


def test_crossings_are_passed_again_on_other_streets() -> None:
    wanted = JourneyConfig(length=2500.0, crossing=0.15, same_way=0.1, reverse=0.0)
    without = JourneyConfig(length=2500.0, crossing=0.0, same_way=0.1, reverse=0.0)
    shares = np.array(
        [
            [itinerary(street_map(seed), each, seed).crossing for each in (wanted, without)]
            for seed in range(4)
        ]
    )
    assert shares[:, 0].mean() > 0.05 > shares[:, 1].mean()


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
    assert first.plan == second.plan
    away = cKDTree(first.path.xy).query(second.path.xy)[0]
    assert 0.01 < np.median(away) < 2.0
    assert first.duration_s != second.duration_s
    assert drive(4).plan != first.plan
