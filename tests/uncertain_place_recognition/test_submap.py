"""Submaps: no ground, a fixed number of points, one scale."""

import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from uncertain_place_recognition.submap import (
    SubmapConfig,
    SubmapMaker,
    benchmark_normalised,
    thinned,
)


def _street(slope: float = 0.0, seed: int = 0) -> PointCloud:
    """Return a road with a wall on either side, rising along x."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-60, -8, 0], [60, 8, 0.05], (20000, 3))
    walls = rng.uniform([-60, -8, 0], [60, 8, 8], (20000, 3))
    walls[:, 1] = np.sign(walls[:, 1]) * 8
    xyz = np.concatenate([ground, walls])
    xyz[:, 2] += slope * xyz[:, 0]
    return PointCloud(xyz.astype(np.float32))


@pytest.mark.parametrize('slope', [0.0, 0.06])
def test_ground_goes_walls_stay_and_the_scale_is_metric(slope):
    settings = SubmapConfig(reach=50.0)
    points = SubmapMaker(settings).make(_street(slope))
    assert points.shape == (4096, 3) and points.dtype == np.float32
    metres = points / settings.scale
    np.testing.assert_allclose(np.abs(metres[:, 1]), 8.0, atol=1e-2)  # walls alone
    assert np.abs(points[:, :2]).max() <= 1.0
    height = metres[:, 2] - slope * metres[:, 0]
    # The lowest point around may lie two cells of 2 m down the road.
    assert 0.39 - 4.0 * slope < height.min() < 1.0 and 7.5 < height.max() <= 8.01


def test_the_same_sweep_gives_the_same_submap_and_density_matters_little():
    maker = SubmapMaker()
    one, again, half = maker.make(_street()), maker.make(_street()), _street()
    np.testing.assert_array_equal(one, again)
    half = maker.make(half.select(np.arange(0, len(half), 2)))
    cells = [{tuple(c) for c in np.floor(p / 0.02).astype(int)} for p in (one, half)]
    assert len(cells[0] & cells[1]) / len(cells[0] | cells[1]) > 0.6


def test_bad_points_and_echoes_below_the_road_change_nothing():
    cloud = _street()
    worse = np.concatenate(
        [cloud.xyz, [[np.nan, 1, 1], [np.inf, 0, 0], [5, 0, -40]]]
    ).astype(np.float32)  # fmt: skip
    np.testing.assert_array_equal(SubmapMaker().make(PointCloud(worse)), SubmapMaker().make(cloud))


def test_too_few_points_are_no_submap():
    with pytest.raises(DataError, match='at least 200 points above the ground'):
        SubmapMaker().make(PointCloud(np.zeros((0, 3), np.float32)))
    flat = np.random.default_rng(0).uniform([-40, -40, 0], [40, 40, 0.1], (5000, 3))
    with pytest.raises(DataError, match='got 0 of 5000'):
        SubmapMaker().make(PointCloud(flat.astype(np.float32)))


@pytest.mark.parametrize('number', [10, 100, 300, 5000])
def test_thinning_gives_the_number_asked_for_from_few_and_from_many(number):
    xyz = np.random.default_rng(1).uniform(-20, 20, (number, 3)).astype(np.float32)
    found = thinned(xyz, 256)
    assert found.shape == (256, 3)
    assert (np.abs(found) <= 20.0).all()
    if number <= 256:  # every point is still there
        assert {tuple(p) for p in xyz} == {tuple(p) for p in found}


def test_the_benchmarks_normalisation_is_centred_scaled_and_negated():
    rng = np.random.default_rng(2)
    xyz = rng.normal([100, -50, 3], [10, 5, 2], (3000, 3))
    found = benchmark_normalised(xyz, 4096)
    assert found.shape == (4096, 3) and np.abs(found).max() <= 1.0
    centred = xyz - xyz.mean(0)
    expected = -centred * 0.5 / np.linalg.norm(centred, axis=1).mean()
    inside = expected[(np.abs(expected) <= 1).all(1)]
    np.testing.assert_allclose(found[: len(inside)], inside, atol=1e-6)
    assert {tuple(p) for p in found} == {tuple(p) for p in inside.astype(np.float32)}
    with pytest.raises(DataError, match='different points'):
        benchmark_normalised(np.ones((5, 3)))
