"""The tiled map against one dictionary of voxels filled point by point."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.map_cloud import MapCloud, MapCloudConfig

SETTINGS = MapCloudConfig(voxel=0.5, range=30.0, tile=20.0)


def _clouds(count: int, points: int = 400) -> dict[int, np.ndarray]:
    random = np.random.default_rng(7)
    scale = [20.0, 20.0, 3.0]
    return {k: (random.normal(size=(points, 3)) * scale).astype(np.float32) for k in range(count)}


def _drive(count: int, bend: float = 0.0) -> np.ndarray:
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ se3.exp([2.0, 0, 0.05, 0, 0.01, 0.1 + bend]))
    return np.array(poses)


def _by_id(T_map_base: np.ndarray) -> dict[int, np.ndarray]:
    return dict(enumerate(T_map_base))


def _brute_force(clouds: dict[int, np.ndarray], T_map_base: np.ndarray) -> set[tuple[float, ...]]:
    voxels: dict[tuple[int, ...], tuple[float, ...]] = {}
    for id_, T in enumerate(T_map_base):
        for point in clouds[id_]:
            if float(point @ point) > SETTINGS.range**2:
                continue
            in_map = T[:3, :3] @ point.astype(np.float64) + T[:3, 3]
            voxel = tuple(np.floor(in_map / SETTINGS.voxel).astype(int).tolist())
            voxels.setdefault(voxel, tuple(in_map.astype(np.float32).tolist()))
    return set(voxels.values())


def _points(cloud: MapCloud) -> set[tuple[float, ...]]:
    points = cloud.points()
    unique = {tuple(p) for p in points.tolist()}
    assert len(unique) == len(points)
    return unique


def _same(ours: set[tuple[float, ...]], expected: set[tuple[float, ...]]) -> None:
    assert len(ours) == len(expected)
    a, b = np.array(sorted(ours)), np.array(sorted(expected))
    np.testing.assert_allclose(a, b, atol=1e-4)


def test_built_at_once_and_one_by_one_it_is_the_brute_force_map() -> None:
    clouds, poses = _clouds(12), _drive(12)
    expected = _brute_force(clouds, poses)
    at_once = MapCloud(SETTINGS, clouds.__getitem__)
    assert at_once.update(_by_id(poses)) == 12
    _same(_points(at_once), expected)
    grown = MapCloud(SETTINGS, clouds.__getitem__)
    for count in range(1, 13):
        assert grown.update(_by_id(poses[:count])) == 1
    np.testing.assert_array_equal(grown.points(), at_once.points())


def test_after_a_loop_bends_the_path_it_is_the_map_of_the_new_path() -> None:
    clouds = _clouds(12)
    cloud = MapCloud(SETTINGS, clouds.__getitem__)
    cloud.update(_by_id(_drive(12)))
    bent = _drive(12, bend=0.05)
    cloud.update(_by_id(bent))
    # The first poses move less than the tolerance and stay where they were included.
    tolerance = SETTINGS.voxel / 2
    included = _drive(12)
    for k in range(12):
        shift = np.abs(included[k, :3, 3] - bent[k, :3, 3]).sum()
        turn = np.linalg.norm(included[k, :3, :3] - bent[k, :3, :3])
        if shift + turn * SETTINGS.range > tolerance:
            included[k] = bent[k]
    _same(_points(cloud), _brute_force(clouds, included))


def test_only_what_changed_is_looked_at() -> None:
    random = np.random.default_rng(1)
    clouds = {k: random.uniform(-5, 5, (50, 3)).astype(np.float32) for k in range(50)}
    asked: list[int] = []

    def points_of(id_: int) -> np.ndarray:
        asked.append(id_)
        return clouds[id_]

    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = 100.0 * np.arange(50)
    cloud = MapCloud(SETTINGS, points_of)
    cloud.update(_by_id(poses))
    asked.clear()
    assert cloud.update(_by_id(poses)) == 0
    assert asked == []
    poses[20, 1, 3] += 3.0
    assert cloud.update(_by_id(poses)) == 1
    assert set(asked) == {20}
    _same(_points(cloud), _brute_force(clouds, poses))


def test_without_keyframes_or_points_the_map_is_empty() -> None:
    cloud = MapCloud(SETTINGS, lambda _: np.empty((0, 3), np.float32))
    assert cloud.points().shape == (0, 3)
    cloud.update(_by_id(_drive(3)))
    assert cloud.points().shape == (0, 3)


@pytest.mark.parametrize('seed', range(3))
def test_random_updates_never_differ_from_the_brute_force_map(seed: int) -> None:
    random = np.random.default_rng(seed)
    clouds, poses = _clouds(10, points=120), _drive(10)
    cloud = MapCloud(SETTINGS, clouds.__getitem__)
    count = 3
    for _ in range(8):
        count = min(10, count + int(random.integers(0, 3)))
        for k in random.integers(0, count, 2):
            poses[k] = poses[k] @ se3.exp([*random.uniform(1, 30, 3), 0, 0, random.uniform(1, 3)])
        cloud.update(_by_id(poses[:count]))
        _same(_points(cloud), _brute_force(clouds, poses[:count]))
