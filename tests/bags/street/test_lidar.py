"""Ray casting against surfaces whose distances are known in closed form."""

import numpy as np
import pytest

from bags.street.lidar import LidarConfig, SpinningLidar
from bags.street.mesh import REFLECTIVITY, Material, MeshBuilder
from lcd_common import se3

CLEAN = LidarConfig(columns=90, range_noise=0.0, dropout=0.0)


def room(half: float, material: Material) -> SpinningLidar:
    """A cube seen from inside."""
    mesh = MeshBuilder()
    mesh.box(np.zeros(3), (2 * half, 2 * half, 2 * half), 0.0, material)
    return SpinningLidar(mesh.build(), CLEAN)


def test_points_lie_on_the_walls_of_a_room() -> None:
    cloud = room(10.0, Material.PLASTER).scan(np.eye(4), np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(cloud.xyz).max(axis=1), 10.0, atol=1e-4)
    assert len(cloud) > 0.97 * 90 * 64
    assert cloud.time_s is None


def test_beams_have_the_elevations_of_an_hdl64() -> None:
    cloud = room(10.0, Material.PLASTER).scan(np.eye(4), np.random.default_rng(0))
    elevation = np.degrees(np.arcsin(cloud.xyz[:, 2] / np.linalg.norm(cloud.xyz, axis=1)))
    beams = np.unique(elevation.round(2))
    assert len(beams) == 64
    assert (beams[-1], beams[0]) == (2.0, -24.8)


def test_points_are_in_the_sensor_frame() -> None:
    T_world_lidar = se3.exp([1.0, -2.0, 0.5, 0.0, 0.0, 0.7])
    cloud = room(10.0, Material.PLASTER).scan(T_world_lidar, np.random.default_rng(0))
    world = se3.transform_points(T_world_lidar, cloud.xyz)
    np.testing.assert_allclose(np.abs(world).max(axis=1), 10.0, atol=1e-4)


def test_a_moving_sweep_is_straightened_by_its_times() -> None:
    mesh = MeshBuilder()
    mesh.box(np.zeros(3), (20.0, 20.0, 20.0), 0.0, Material.PLASTER)
    settings = LidarConfig(columns=90, range_noise=0.0, dropout=0.0, point_time=True)
    lidar = SpinningLidar(mesh.build(), settings)
    twist = np.array([10.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    poses = np.array([se3.exp(twist * t) for t in lidar.column_time_s])
    cloud = lidar.scan(poses, np.random.default_rng(0))
    assert cloud.time_s is not None
    assert cloud.time_s.min() == 0.0 and 0.09 < cloud.time_s.max() < 0.1
    as_measured = np.abs(cloud.xyz).max(axis=1)
    assert np.abs(as_measured - 10.0).max() > 0.3
    straight = [
        se3.transform_points(se3.exp(twist * t), xyz[None])[0]
        for t, xyz in zip(cloud.time_s.astype(float), cloud.xyz.astype(float), strict=True)
    ]
    np.testing.assert_allclose(np.abs(straight).max(axis=1), 10.0, atol=1e-3)


def test_intensity_falls_with_incidence_and_follows_the_material() -> None:
    bright = room(10.0, Material.METAL).scan(np.eye(4), np.random.default_rng(0))
    dark = room(10.0, Material.ASPHALT).scan(np.eye(4), np.random.default_rng(0))
    assert bright.intensity is not None and dark.intensity is not None
    ratio = bright.intensity.mean() / dark.intensity.mean()
    expected = REFLECTIVITY[Material.METAL] / REFLECTIVITY[Material.ASPHALT]
    assert ratio == pytest.approx(expected, rel=0.1)
    wall = bright.xyz[:, 0] > 9.99
    straight = np.abs(bright.xyz[:, 1]) < 2.0
    assert bright.intensity[wall & straight].mean() > bright.intensity[wall & ~straight].mean()


def test_noise_and_dropout_are_what_the_settings_say() -> None:
    mesh = MeshBuilder()
    mesh.box(np.zeros(3), (20.0, 20.0, 20.0), 0.0, Material.PLASTER)
    settings = LidarConfig(columns=720, range_noise=0.05, dropout=0.3)
    cloud = SpinningLidar(mesh.build(), settings).scan(np.eye(4), np.random.default_rng(0))
    assert len(cloud) / (720 * 64) == pytest.approx(0.7 * 0.99, abs=0.01)
    direction = cloud.xyz / np.linalg.norm(cloud.xyz, axis=1, keepdims=True)
    true_range = 10.0 / np.abs(direction).max(axis=1)
    noise = np.linalg.norm(cloud.xyz, axis=1) - true_range
    assert noise.std() == pytest.approx(0.05, rel=0.03)
    assert abs(noise.mean()) < 0.002


def test_nothing_comes_back_from_too_near_or_too_far() -> None:
    near = room(0.8, Material.METAL).scan(np.eye(4), np.random.default_rng(0))
    assert len(near) == 0
    far = SpinningLidar(_plate(150.0), CLEAN).scan(np.eye(4), np.random.default_rng(0))
    assert len(far) == 0


def _plate(distance: float):  # type: ignore[no-untyped-def]
    mesh = MeshBuilder()
    mesh.box(np.array([distance, 0.0, 0.0]), (0.1, 50.0, 50.0), 0.0, Material.METAL)
    return mesh.build()
