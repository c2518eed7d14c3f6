"""Clouds keep points, intensity and time together."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.errors import DataError


def cloud(n: int = 50) -> PointCloud:
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 20, (n, 3)).astype(np.float32)
    return PointCloud(xyz, np.arange(n, dtype=np.float32), np.linspace(0, 0.1, n, dtype=np.float32))


def test_lengths_must_agree() -> None:
    with pytest.raises(DataError, match='intensity must have one value for each of the 50 points'):
        PointCloud(cloud().xyz, np.zeros(49, np.float32))
    with pytest.raises(DataError, match='N x 3'):
        PointCloud(np.zeros((3, 4), np.float32))


def test_nan_points_go_with_their_time_and_intensity() -> None:
    full = cloud()
    full.xyz[[3, 7]] = np.nan
    full.xyz[9, 2] = np.inf
    clean = full.finite()
    assert len(clean) == 47
    assert clean.intensity is not None and clean.time_s is not None
    assert not {3.0, 7.0, 9.0} & set(clean.intensity.tolist())
    np.testing.assert_array_equal(clean.time_s, np.delete(full.time_s, [3, 7, 9]))
    assert clean.finite() is clean


def test_within_is_inclusive_and_by_range() -> None:
    points = PointCloud(np.array([[3, 0, 0], [0, 4, 0], [0, 3, 4]], np.float32))
    np.testing.assert_array_equal(points.within(4.0, 5.0).xyz, points.xyz[1:])


def test_transformed_moves_only_the_points() -> None:
    T = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    before = cloud()
    after = before.transformed(T)
    np.testing.assert_allclose(after.xyz, before.xyz @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    assert after.intensity is before.intensity


def test_voxel_first_agrees_with_a_dictionary() -> None:
    xyz = np.random.default_rng(2).uniform(-5, 5, (2000, 3))
    seen: dict[tuple[int, ...], int] = {}
    for i, point in enumerate(xyz):
        seen.setdefault(tuple(np.floor(point / 0.7).astype(int)), i)
    np.testing.assert_array_equal(voxel_first(xyz, 0.7), sorted(seen.values()))
    assert len(voxel_first(np.empty((0, 3)), 0.5)) == 0
