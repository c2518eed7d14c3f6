"""Intensity Scan Context against its formulas, written out."""

import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.baselines.intensity_scan_context import (
    IntensityScanContext,
    IntensityScanContextConfig,
)

SMALL = IntensityScanContextConfig(rings=5, sectors=12, turn_tolerance=1)


def by_the_paper(query, match, tolerance):
    """Turn by the bins that agree to be occupied; distance by cosines of columns around it."""
    sectors = query.shape[1]
    agree = [((np.roll(query, k, axis=1) > 0) == (match > 0)).sum() for k in range(sectors)]
    best, turn = np.inf, 0
    for shift in range(
        agree.index(max(agree)) - tolerance, agree.index(max(agree)) + tolerance + 1
    ):
        cosines = []
        for x, y in zip(np.roll(query, shift, axis=1).T, match.T, strict=True):
            if x.any() and y.any():
                cosines.append(x @ y / np.linalg.norm(x) / np.linalg.norm(y))
        distance = 1 - np.mean(cosines) if cosines else 1.0
        if distance < best:
            best, turn = distance, shift
    return best, turn, max(agree) / query.size


def images(rng, count, shape=(5, 12)):
    return (rng.uniform(0.1, 1.0, (count, *shape)) * (rng.random((count, *shape)) < 0.5)).astype(
        np.float32
    )


def scattered(rng, count=3000):
    sector, distance = rng.integers(0, 60, count), rng.uniform(3.0, 79.0, count)
    azimuth = 2 * np.pi * (sector + 0.5) / 60
    height = rng.uniform(1.0, 9.0, count)
    xyz = np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height])
    return xyz.astype(np.float32), rng.uniform(0.0, 1.0, count).astype(np.float32)


@pytest.mark.parametrize('tolerance', [0, 2])
def test_distances_and_yaws_are_those_of_the_formulas(tolerance):
    rng = np.random.default_rng(0)
    isc = IntensityScanContext(
        IntensityScanContextConfig(rings=5, sectors=12, turn_tolerance=tolerance)
    )
    query, *matches = images(rng, 40)
    rows = np.array([isc.row(image.ravel()) for image in matches])
    assert rows.shape == (39, isc.row_length)
    distance, yaw = isc.compare(isc.row(query.ravel()), rows)
    for image, got, heading in zip(matches, distance, yaw, strict=True):
        expected, turn, _ = by_the_paper(query, image, tolerance)
        assert got == pytest.approx(expected, abs=1e-5)
        assert np.cos(heading - 2 * np.pi * turn / 12) == pytest.approx(1.0, abs=1e-6)


def test_little_agreement_of_geometry_rules_a_match_out():
    rng = np.random.default_rng(1)
    query, *matches = images(rng, 40)
    limit = 0.65
    isc = IntensityScanContext(
        IntensityScanContextConfig(rings=5, sectors=12, turn_tolerance=1, min_geometry=limit)
    )
    rows = np.array([isc.row(image.ravel()) for image in matches])
    distance, _ = isc.compare(isc.row(query.ravel()), rows)
    agreement = np.array([by_the_paper(query, image, 1)[2] for image in matches])
    assert 0 < np.sum(agreement >= limit) < len(matches)
    np.testing.assert_array_equal(np.isfinite(distance), agreement >= limit)


@pytest.mark.parametrize('sectors_turned', [0, 1, 17, 30, 59])
def test_a_turn_by_whole_sectors_is_found_exactly(sectors_turned):
    xyz, intensity = scattered(np.random.default_rng(2))
    yaw = 2 * np.pi * sectors_turned / 60
    c, s = np.cos(yaw), np.sin(yaw)
    # The query's vehicle is turned by yaw, so its points turn the other way.
    query = xyz @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
    isc = IntensityScanContext()
    match_row, query_row = (
        isc.row(isc.describe(PointCloud(points, intensity))) for points in (xyz, query)
    )
    distance, found = isc.compare(query_row, match_row[None])
    assert distance[0] == pytest.approx(0.0, abs=1e-5)
    assert np.cos(found[0] - yaw) == pytest.approx(1.0, abs=1e-6)


def test_bins_hold_the_largest_intensity_above_the_ground():
    xyz = np.array([[10, 0.1, 1], [10.1, 0.2, 3], [10, 0.1, 0.1], [200, 0, 9], [10, 0.1, np.nan]])
    cloud = PointCloud(xyz.astype(np.float32), np.array([20, 70, 255, 90, 255], np.float32))
    isc = IntensityScanContext(IntensityScanContextConfig(full_intensity=255.0))
    image = isc.describe(cloud).reshape(20, 60)
    assert image[2, 0] == pytest.approx(70 / 255)
    assert np.count_nonzero(image) == 1


def test_it_does_not_apply_without_intensity():
    with pytest.raises(DataError, match='not applicable: the sweep has no intensities'):
        IntensityScanContext().describe(PointCloud(np.ones((3, 3), np.float32)))


def test_a_descriptor_of_another_shape_is_refused():
    with pytest.raises(DataError, match='1200 numbers, got 60'):
        IntensityScanContext().row(np.zeros(60, np.float32))
