"""A sweep has its points, labels and times where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from bags.simulation.embree import EmbreeCaster
from bags.simulation.lidar import LidarSensor, LidarSweep
from bags.simulation.lidar_model import lidar_model
from bags.simulation.scene import Mover, Scene
from bags.street.mesh import Label, Material, Mesh, MeshBuilder
from lcd_common import se3

# With a perfect calibration: where points lie is then a matter of noise alone.
MODEL = replace(lidar_model('hdl64'), columns=900, angle_sigma_rad=0.0)


def room() -> Mesh:
    """Return a road with a wall 15 m ahead and one 20 m to the left."""
    mesh = MeshBuilder()
    mesh.label = Label.ROAD
    flat = [[-60, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]]
    mesh.quads(np.array([flat], np.float64), Material.ASPHALT)
    mesh.label = Label.BUILDING
    mesh.box(np.array([15.5, 0.0, 5.0]), (1.0, 60.0, 10.0), 0.0, Material.PLASTER)
    mesh.box(np.array([0.0, 20.5, 5.0]), (60.0, 1.0, 10.0), 0.0, Material.PLASTER)
    return mesh.build()


def box_car() -> Mesh:
    mesh = MeshBuilder()
    mesh.label = Label.CAR
    mesh.box(np.array([0.0, 0.0, 1.0]), (4.0, 2.0, 2.0), 0.0, Material.PLASTER)
    return mesh.build()


def passing_car() -> Mover:
    """Return a car that drives past on the right, 10 m/s, at x = 0 after one second."""
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = [-10.0, 0.0, 10.0], -8.0
    return Mover(box_car(), np.array([0.0, 1.0, 2.0]), T)


@pytest.fixture(scope='module')
def sensor() -> LidarSensor:
    return LidarSensor(MODEL, EmbreeCaster(Scene(room(), (passing_car(),))), seed=5)


def pose(x: float = 0.0, y: float = 0.0, heading: float = 0.0) -> se3.Array:
    T = se3.rotation_z(heading)
    T[:3, 3] = [x, y, 1.73]
    return T


def sweep(sensor: LidarSensor, T: se3.Array, time_s: float = 0.0, seed: int = 0) -> LidarSweep:
    return sensor.sweep(T, time_s, np.random.default_rng(seed))


def test_points_lie_on_what_their_labels_say(sensor: LidarSensor) -> None:
    found = sweep(sensor, pose(heading=0.4))
    world = se3.transform_points(pose(heading=0.4), found.cloud.xyz.astype(float))
    road, wall = world[found.label == Label.ROAD], world[found.label == Label.BUILDING]
    assert len(road) > 5000 and len(wall) > 5000
    assert np.abs(np.median(road[:, 2])) < 0.01
    off = np.minimum(np.abs(wall[:, 0] - 15.0), np.abs(wall[:, 1] - 20.0))
    # A wall's rim may be mixed with the road or the sky behind it.
    assert np.quantile(off, 0.98) < 4 * 0.025


def test_two_sweeps_overlap_within_the_noise(sensor: LidarSensor) -> None:
    """The walls' planes, fitted to each sweep in the world, coincide."""
    for T in (pose(), pose(-6.0, 5.0, 2.0)):
        found = sweep(sensor, T)
        world = se3.transform_points(T, found.cloud.xyz.astype(float))
        wall = world[(found.label == Label.BUILDING) & (np.abs(world[:, 0] - 15.0) < 0.3)]
        assert wall[:, 0].mean() == pytest.approx(15.0, abs=0.01)
        assert wall[:, 0].std() < np.hypot(MODEL.range_sigma_m, MODEL.beam_sigma_m) * 1.5


def test_only_what_moves_is_moving_and_it_is_where_it_is_then(sensor: LidarSensor) -> None:
    for time_s, x in ((0.5, -5.0), (1.5, 5.0)):
        found = sweep(sensor, pose(), time_s)
        car = found.label == Label.MOVING_CAR
        assert car.sum() > 100
        np.testing.assert_array_equal(found.moving, car)
        inside = np.abs(found.cloud.xyz[car] - [x, -8.0, -0.73]) < [2.3, 1.3, 1.3]
        assert inside.all(axis=1).mean() > 0.97
    assert not sweep(sensor, pose(), 5.0).moving.any()


def test_same_generator_same_bytes(sensor: LidarSensor) -> None:
    first, again, other = (sweep(sensor, pose(), 0.5, seed) for seed in (1, 1, 2))
    assert first.cloud.xyz.tobytes() == again.cloud.xyz.tobytes()
    assert first.cloud.intensity is not None and again.cloud.intensity is not None
    assert first.cloud.intensity.tobytes() == again.cloud.intensity.tobytes()
    assert first.cloud.xyz.tobytes() != other.cloud.xyz.tobytes()


def test_a_moving_sweep_is_distorted_until_its_times_are_used(sensor: LidarSensor) -> None:
    column_s = MODEL.column_time_s()
    T = np.array([pose(-10.0 + 15.0 * t, 0.0, 0.5 * t) for t in column_s])
    found = sweep(sensor, T)
    time_s = found.cloud.time_s
    assert time_s is not None and time_s.min() < 0.01 and time_s.max() > 0.09
    ahead = (found.label == Label.BUILDING) & (np.abs(found.cloud.xyz[:, 1]) < 12.0)
    column = found.ray // len(MODEL.elevation_rad)
    np.testing.assert_allclose(time_s, column_s[column], atol=1e-6)
    xyz = found.cloud.xyz.astype(float)
    world = np.einsum('nij,nj->ni', T[column, :3, :3], xyz) + T[column, :3, 3]
    frozen = se3.transform_points(T[0], xyz)
    near = ahead & (np.abs(world[:, 0] - 15.0) < 1.0)
    assert near.sum() > 1000
    assert np.abs(world[near, 0] - 15.0).mean() < 0.05 < np.abs(frozen[near, 0] - 15.0).mean()


def test_blocked_sectors_are_empty() -> None:
    model = MODEL.blocked((-90.0, 90.0))
    found = LidarSensor(model, EmbreeCaster(Scene(room()))).sweep(
        pose(), 0.0, np.random.default_rng(0)
    )
    assert len(found.cloud) > 1000
    assert found.cloud.xyz[:, 0].max() < 0.1
