"""Fixes are good in the open, worse between houses, and missing in a canyon."""

import numpy as np
import pytest

from bags.simulation.embree import EmbreeCaster
from bags.simulation.satellites import ReceiverConfig, geodetic, receive, sky
from bags.simulation.scene import Scene
from bags.street.mesh import Label, Material, MeshBuilder


def canyon(height: float) -> EmbreeCaster:
    """Return two long walls 12 m apart along x, for x > 0."""
    mesh = MeshBuilder()
    mesh.label = Label.BUILDING
    for y in (-6.5, 6.5):
        centre = np.array([200.0, y, height / 2])
        mesh.box(centre, (400.0, 1.0, height), 0.0, Material.BRICK)
    return EmbreeCaster(Scene(mesh.build()))


def along(x: float, count: int) -> np.ndarray:
    return np.tile([x, 0.0, 1.6], (count, 1)).astype(float)


def test_satellites_are_above_the_mask() -> None:
    vectors = sky(ReceiverConfig(satellites=40), 3)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)
    assert vectors[:, 2].min() >= np.sin(np.radians(10.0))


def test_in_the_open_all_are_seen_and_errors_fit_their_covariance() -> None:
    settings = ReceiverConfig(memory=0.0)
    found = receive(along(-300.0, 4000), canyon(20.0), settings, 5)
    assert found.has_fix.all() and (found.visible == settings.satellites).all()
    mine = np.cov(found.error_enu.T)
    np.testing.assert_allclose(mine, found.covariance_enu[0], atol=0.1 * np.abs(mine).max())
    # By the textbook: unit range errors through the inverse of the geometry.
    to_satellite = sky(settings, 5)
    G = np.column_stack([-to_satellite, np.ones(len(to_satellite))])
    expected = np.linalg.inv(G.T @ G)[:3, :3] * settings.range_noise**2
    np.testing.assert_allclose(found.covariance_enu[0], expected, rtol=1e-9)


def test_canyons_cost_satellites_precision_and_at_last_the_fix() -> None:
    settings = ReceiverConfig()
    open_field = receive(along(-300.0, 2), canyon(3.0), settings, 5)
    street = receive(along(200.0, 2), canyon(8.0), settings, 5)
    gorge = receive(along(200.0, 2), canyon(60.0), settings, 5)
    assert open_field.visible[0] > street.visible[0] > gorge.visible[0]
    assert np.trace(street.covariance_enu[0]) > 1.5 * np.trace(open_field.covariance_enu[0])
    assert not gorge.has_fix.any()
    assert np.isnan(gorge.error_enu).all()


def test_errors_are_remembered_for_a_while() -> None:
    settings = ReceiverConfig(memory=20.0)
    error = receive(along(-300.0, 5000), canyon(3.0), settings, 1).error_enu[:, 0]
    error = error - error.mean()
    lag = [float(np.mean(error[k:] * error[: len(error) - k])) for k in (0, 20)]
    assert lag[1] / lag[0] == pytest.approx(np.exp(-1.0), abs=0.12)


def test_geodetic_positions_return_to_metres() -> None:
    """Against arcs of the ellipsoid: one degree of latitude at 49 degrees is 111,220 m."""
    settings = ReceiverConfig(latitude=49.0, longitude=8.4)
    north = geodetic(np.array([0.0, 111_220.0, 0.0]), settings)
    assert north[0] - 49.0 == pytest.approx(1.0, abs=1e-3)
    east = geodetic(np.array([1000.0, 0.0, 7.0]), settings)
    expected = np.degrees(1000.0 / (6_390_331.0 * np.cos(np.radians(49.0))))
    assert east[1] - 8.4 == pytest.approx(expected, rel=1e-6)
    assert east[2] == 7.0
