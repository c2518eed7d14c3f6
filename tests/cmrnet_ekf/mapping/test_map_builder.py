import numpy as np
import pytest

from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig, near_origin
from cmrnet_ekf.mapping.map_builder import MapBuilder, neighbours
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError, MapError

T_BASE_SENSOR = se3.from_rotation_translation(np.eye(3), [0.5, 0.0, 1.7])


def ground_and_walls(rng: np.random.Generator) -> np.ndarray:
    """World points: a road along x with walls at both sides."""
    ground = np.column_stack(
        [rng.uniform(-20, 60, 40000), rng.uniform(-8, 8, 40000), np.full(40000, 0.05)]
    )
    walls = np.column_stack(
        [rng.uniform(-20, 60, 40000), rng.choice([-8.05, 8.05], 40000), rng.uniform(0, 5, 40000)]
    )
    return np.concatenate([ground, walls])


def sweep(world: np.ndarray, T_map_base: np.ndarray) -> PointCloud:
    T_sensor_map = se3.inverse(T_map_base @ T_BASE_SENSOR)
    return PointCloud(se3.transform_points(T_sensor_map, world).astype(np.float32))


def at(x: float, yaw: float = 0.0) -> np.ndarray:
    return se3.from_rotation_translation(se3.so3_exp([0, 0, yaw]), [x, 0.0, 0.0])


def everything(folder: TileFolder) -> np.ndarray:
    return np.concatenate(list(folder.clouds()))


PLAIN = MapConfig(see_through=False, neighbours=0, tile=10.0, voxel=0.2)


def test_each_voxel_keeps_one_measured_point(tmp_path):
    rng = np.random.default_rng(0)
    world = ground_and_walls(rng)
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', PLAIN), PLAIN)
    builder.add(sweep(world, at(0)), at(0), T_BASE_SENSOR)
    builder.add(sweep(world, at(5, 0.3)), at(5, 0.3), T_BASE_SENSOR)
    count = builder.finish()
    points = everything(builder.folder)
    assert len(points) == count
    seen = np.zeros(len(world), bool)
    for T in (at(0), at(5, 0.3)):
        base = se3.transform_points(se3.inverse(T), world)
        seen |= (np.abs(base[:, :2]).max(1) > 3.0) & (np.linalg.norm(base, axis=1) < 60.0)
    expected = np.unique(np.floor(world[seen] / 0.2), axis=0)
    voxels = np.unique(np.floor(points / 0.2), axis=0)
    # A point on the border of two voxels falls into either, as rounding goes.
    assert len(voxels) == pytest.approx(len(points), rel=1e-3)
    assert len(voxels) == pytest.approx(len(expected), rel=1e-3)
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(world).query(points)
    assert distance.max() < 1e-4


def test_far_from_the_origin_nothing_is_lost(tmp_path):
    rng = np.random.default_rng(1)
    world = rng.uniform(-15, 15, (2000, 3))
    far = np.array([500_000.0, -4_000_000.0, 120.0])
    T = se3.from_rotation_translation(np.eye(3), far)
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', PLAIN), PLAIN)
    builder.add(sweep(world, np.eye(4)), T, T_BASE_SENSOR)
    builder.finish()
    points = everything(builder.folder) - far
    from scipy.spatial import cKDTree

    assert cKDTree(world).query(points)[0].max() < 1e-4
    local, origin = LocalMap(tmp_path / 'map').around(T)
    assert cKDTree(world).query(local + (origin - far))[0].max() < 1e-4
    assert np.linalg.norm(near_origin(T, origin)[:2, 3]) < 20.0


def test_a_map_grows_and_a_small_buffer_makes_the_same(tmp_path):
    rng = np.random.default_rng(2)
    world = ground_and_walls(rng)
    poses = [at(0), at(4), at(8, 0.2)]
    clouds = {}
    for name, buffer, stops in (('one', 10**6, ()), ('two', 1000, ()), ('three', 10**6, (0, 1))):
        settings = MapConfig(see_through=False, tile=10.0, buffer=buffer)
        builder = MapBuilder(TileFolder.create(tmp_path / name, settings), settings)
        for number, T in enumerate(poses):
            builder.add(sweep(world, T), T, T_BASE_SENSOR)
            if number in stops:
                builder.finish()
                builder = MapBuilder(TileFolder.create(tmp_path / name, settings), settings)
        builder.finish()
        cloud = everything(builder.folder)
        clouds[name] = cloud[np.lexsort(cloud.T)]
    np.testing.assert_array_equal(clouds['one'], clouds['two'])
    np.testing.assert_array_equal(clouds['one'], clouds['three'])


def test_a_car_that_left_is_seen_through_and_the_street_stays(tmp_path):
    rng = np.random.default_rng(3)
    settings = MapConfig(tile=10.0, evidence_spacing=0.5)
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', settings), settings)
    car = np.column_stack(
        [np.full(3000, 12.0), rng.uniform(-1, 1, 3000), rng.uniform(0.3, 1.6, 3000)]
    )
    street = ground_and_walls(rng)
    for number in range(6):
        T = at(float(number))
        world = street
        if number == 0:
            # Behind the car the sweep sees nothing.
            angle = np.abs(np.arctan2(street[:, 1], street[:, 0] - 0.5))
            behind = (street[:, 0] > 12.0) & (angle < np.arctan(1.0 / 11.5))
            world = np.concatenate([street[~behind], car])
        builder.add(sweep(world, T), T, T_BASE_SENSOR)
    builder.finish()
    kept = everything(builder.folder)
    on_car = (np.abs(kept[:, 0] - 12) < 0.1) & (np.abs(kept[:, 1]) < 1) & (kept[:, 2] > 0.5)
    assert on_car.sum() < 20
    every = np.unique(np.floor(street[np.abs(street[:, :2]).max(1) > 3] / 0.1), axis=0)
    found = np.unique(np.floor(kept[~on_car] / 0.1), axis=0)
    assert len(found) > 0.9 * len(every)


def test_labels_leave_out_what_moves(tmp_path):
    world = ground_and_walls(np.random.default_rng(4))
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', PLAIN), PLAIN)
    builder.add(sweep(world, at(0)), at(0), T_BASE_SENSOR, moving=world[:, 2] > 1.0)
    builder.finish()
    assert everything(builder.folder)[:, 2].max() <= 1.01


def test_single_points_in_the_air_are_outliers(tmp_path):
    world = ground_and_walls(np.random.default_rng(5))
    in_the_air = np.array([[10.0, 2.0, 4.0], [15.0, -3.0, 3.0]])
    settings = MapConfig(see_through=False)
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', settings), settings)
    both = np.concatenate([world, in_the_air])
    builder.add(sweep(both, at(0)), at(0), T_BASE_SENSOR)
    builder.finish()
    kept = everything(builder.folder)
    for point in in_the_air:
        assert np.linalg.norm(kept - point, axis=1).min() > 0.5


def test_neighbours_are_counted_as_a_loop_counts_them():
    rng = np.random.default_rng(6)
    points = rng.uniform(0, 3, (400, 3)).astype(np.float32)
    cell = np.floor(points / 0.3).astype(int)
    expected = [int((np.abs(cell - own).max(1) <= 1).sum()) - 1 for own in cell]
    np.testing.assert_array_equal(neighbours(points), expected)


def test_the_local_map_is_the_box_and_little_more(tmp_path):
    world = ground_and_walls(np.random.default_rng(7))
    builder = MapBuilder(TileFolder.create(tmp_path / 'map', PLAIN), PLAIN)
    builder.add(sweep(world, at(-30)), at(-30), T_BASE_SENSOR)
    builder.add(sweep(world, at(30)), at(30), T_BASE_SENSOR)
    builder.finish()
    whole = everything(builder.folder)
    settings = LocalMapConfig(ahead=20.0, behind=5.0, beside=10.0, kept_tiles=3)
    local = LocalMap(tmp_path / 'map', settings)
    for T in (at(10, 0.5), at(10, 0.5), at(30, 2.0)):
        points, origin = local.around(T)
        points = points + origin
        base = se3.transform_points(se3.inverse(T), whole)

        def within(p, grown):
            return (p[:, 0] > -5 - grown) & (p[:, 0] < 20 + grown) & (np.abs(p[:, 1]) < 10 + grown)

        assert len(points) >= within(base, 0).sum() > 1000
        assert within(se3.transform_points(se3.inverse(T), points), 15.0).all()


def test_wrong_folders_and_poses_are_refused(tmp_path):
    with pytest.raises(MapError, match='build_lidar_map'):
        LocalMap(tmp_path)
    (tmp_path / 'note.txt').write_text('mine')
    with pytest.raises(MapError, match='another folder'):
        TileFolder.create(tmp_path, PLAIN)
    folder = TileFolder.create(tmp_path / 'map', PLAIN)
    with pytest.raises(MapError, match='empty'):
        LocalMap(tmp_path / 'map')
    with pytest.raises(MapError, match='voxels of'):
        TileFolder.create(tmp_path / 'map', MapConfig())
    builder = MapBuilder(folder, PLAIN)
    with pytest.raises(DataError, match='finite'):
        builder.add(PointCloud(np.ones((5, 3), np.float32)), np.full((4, 4), np.nan), T_BASE_SENSOR)
    (tmp_path / 'map' / 'tiles' / '0_0.npz').write_bytes(b'broken')
    with pytest.raises(MapError, match='not readable'):
        LocalMap(tmp_path / 'map').around(np.eye(4))
    (tmp_path / 'map' / 'meta.json').write_text(
        '{"format": "lidar_map", "version": 9, "voxel": 1, "tile": 1}'
    )
    with pytest.raises(MapError, match='version 1'):
        TileFolder.open(tmp_path / 'map')
