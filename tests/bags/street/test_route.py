"""A route keeps its limits, meets its waypoints and is smooth."""

import numpy as np
import pytest

from bags.street.route import Route, abrupt_u_turn, loop


def derivatives(route: Route, h: float = 0.005) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(h, route.duration_s - h, 0.01)
    before, now, after = (route.at(t + d) for d in (-h, 0.0, h))
    velocity = (after - before) / (2 * h)
    acceleration = (after - 2 * now + before) / h**2
    return now, velocity, acceleration


def test_a_drive_keeps_speed_and_acceleration_limits() -> None:
    now, velocity, acceleration = derivatives(loop())
    speed = np.linalg.norm(velocity[:, :2], axis=1)
    assert speed.max() < 13.1
    # 2.5 m/s^2 each way; smoothing in time rounds the profile a little over it.
    assert np.linalg.norm(acceleration[:, :2], axis=1).max() < 4.0
    moving = speed > 1.0
    heading = np.arctan2(velocity[moving, 1], velocity[moving, 0])
    slip = np.angle(np.exp(1j * (heading - now[moving, 2])))
    assert np.abs(slip).max() < 0.02


def test_it_drives_beside_the_centreline() -> None:
    route = Route(speed=10.0).through([(0, 0), (100, 0)], lane=2.0)
    x, y, yaw, travelled = route.at(np.linspace(0, route.duration_s, 50)).T
    np.testing.assert_allclose(y, -2.0, atol=1e-6)
    np.testing.assert_allclose(yaw, 0.0, atol=1e-6)
    assert x[0] == pytest.approx(0.0, abs=0.2) and x[-1] == pytest.approx(100.0, abs=1e-3)
    np.testing.assert_allclose(travelled, x - x[0], atol=1e-3)


def test_the_loop_revisits_one_street_each_way_with_an_offset() -> None:
    route = loop()
    assert 55.0 < route.duration_s < 75.0
    t = np.arange(0.0, route.duration_s, 0.1)
    x, y, yaw, _ = route.at(t).T
    gap = np.hypot(x[:, None] - x[None], y[:, None] - y[None])
    later = t[:, None] - t[None] > 15.0
    turned = np.abs(np.angle(np.exp(1j * (yaw[:, None] - yaw[None]))))
    same = later & (gap < 2.0) & (turned < 0.1)
    reverse = later & (gap < 4.0) & (turned > np.pi - 0.1)
    assert np.any(same, axis=1).sum() > 30 and np.any(reverse, axis=1).sum() > 20
    assert gap[same].min() > 1.0  # 1.25 m apart on the straight
    assert gap[reverse].min() > 3.0


def test_an_abrupt_turn_takes_a_few_sweeps_at_one_place() -> None:
    route = abrupt_u_turn()
    x, y, yaw, _ = route.at(np.arange(0.0, route.duration_s, 0.1)).T
    step = np.abs(np.diff(yaw))
    abrupt = np.flatnonzero(step > np.radians(10.0))
    assert 2 <= len(abrupt) <= 4 and np.ptp(abrupt) < 4
    assert step[abrupt].sum() == pytest.approx(np.pi, abs=0.05)
    assert np.hypot(np.diff(x), np.diff(y))[abrupt].max() < 1e-2


def test_legs_join_without_a_jump() -> None:
    route = Route().through([(0, 0), (40, 0), (40, 30)]).stand(1.0).turn(np.pi, 2.0)
    route = route.through([(40, 30), (40, 10), (10, 10)], lane=-1.75)
    _, velocity, _ = derivatives(route)
    assert np.linalg.norm(velocity[:, :2], axis=1).max() < 10.5
    assert np.abs(velocity[:, 2]).max() < 1.5 * np.pi / 2.0 + 0.3


def test_it_goes_straight_on_beyond_its_ends() -> None:
    route = Route(speed=10.0).through([(0, 0), (100, 0)])
    before, at, inside = route.at([-0.1, 0.0, 0.1])
    np.testing.assert_allclose(at - before, inside - at, atol=1e-3)
    np.testing.assert_allclose(
        route.at(route.duration_s + 5.0), route.at(route.duration_s), atol=1e-2
    )


@pytest.mark.parametrize('waypoints', [[(0, 0)], [(0, 0, 0), (1, 1, 1)], [1, 2, 3]])
def test_too_few_waypoints_are_refused(waypoints: list) -> None:
    with pytest.raises(ValueError, match='at least two waypoints'):
        Route().through(waypoints)


def test_an_empty_route_has_no_poses() -> None:
    with pytest.raises(ValueError, match='empty route'):
        Route().at(0.0)
