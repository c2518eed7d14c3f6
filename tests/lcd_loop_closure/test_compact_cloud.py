"""The stated resolution, memory and refusals of a compact cloud."""

import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.compact_cloud import CompactCloud, compact


def _cloud(range_m: float, count: int = 5000) -> PointCloud:
    random = np.random.default_rng(4)
    xyz = random.uniform(-range_m, range_m, (count, 3)).astype(np.float32)
    return PointCloud(xyz, random.uniform(0, 1, count).astype(np.float32))


@pytest.mark.parametrize('range_m', [0.5, 80.0, 300.0])
def test_every_point_comes_back_within_half_a_step(range_m: float) -> None:
    cloud = _cloud(range_m)
    small = compact(cloud)
    assert small.step_m <= range_m / 32767 * 1.0001
    error = np.abs(small.xyz().astype(np.float64) - cloud.xyz).max()
    assert error <= 0.5 * small.step_m + 1e-5 * range_m
    back = small.cloud()
    assert back.intensity is not None and cloud.intensity is not None
    np.testing.assert_allclose(back.intensity, cloud.intensity, atol=5e-4)
    assert small.nbytes == 8 * len(cloud)


def test_compacting_twice_changes_nothing_more() -> None:
    once = compact(_cloud(80.0)).xyz()
    twice = compact(PointCloud(once)).xyz()
    np.testing.assert_allclose(once, twice, atol=2e-5)


def test_an_empty_cloud_and_missing_returns() -> None:
    assert len(compact(PointCloud(np.empty((0, 3), np.float32)))) == 0
    xyz = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, np.inf]], np.float32)
    small = compact(PointCloud(xyz))
    np.testing.assert_allclose(small.xyz(), [[1, 2, 3]], atol=1e-4)
    assert small.intensity is None


def test_large_intensity_stays_finite() -> None:
    cloud = PointCloud(np.ones((1, 3), np.float32), np.array([1e6], np.float32))
    intensity = compact(cloud).intensity
    assert intensity is not None and np.isfinite(intensity).all()


def test_wrong_arrays_are_refused() -> None:
    steps = np.zeros((4, 3), np.int16)
    with pytest.raises(DataError, match='int16'):
        CompactCloud(steps.astype(np.int32), 0.1)  # type: ignore[arg-type]
    with pytest.raises(DataError, match='positive'):
        CompactCloud(steps, float('nan'))
    with pytest.raises(DataError, match='intensity'):
        CompactCloud(steps, 0.1, np.zeros(3, np.float16))
