import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.scan_context import ScanContext, ScanContextConfig


def paper_distance(a, b):
    """Eq. 5 and 6, written out: the best shift of columns, empty columns left out."""
    best, best_shift = np.inf, 0
    for shift in range(a.shape[1]):
        moved = np.roll(a, shift, axis=1)
        cosines = []
        for x, y in zip(moved.T, b.T, strict=True):
            if np.any(x) and np.any(y):
                cosines.append(x @ y / (np.linalg.norm(x) * np.linalg.norm(y)))
        distance = 1 - sum(cosines) / len(cosines) if cosines else 1.0
        if distance < best:
            best, best_shift = distance, shift
    return best, best_shift


def sparse_contexts(rng, count, rings=20, sectors=60):
    contexts = rng.uniform(0.1, 8.0, (count, rings, sectors))
    contexts *= rng.random(contexts.shape) < 0.4
    contexts[:, :, rng.integers(0, sectors, 5)] = 0.0
    return contexts.astype(np.float32)


def points_in_sector_centres(rng, count, sectors=60):
    sector, distance = rng.integers(0, sectors, count), rng.uniform(3.0, 79.0, count)
    azimuth = 2 * np.pi * (sector + 0.5) / sectors
    height = rng.uniform(0.0, 9.0, count)
    return np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height])


def turned(xyz, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return xyz @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


def test_bins_hold_the_largest_height():
    xyz = np.array([[10.0, 0.1, 1.0], [10.1, 0.2, 3.0], [-50.0, -1.0, 2.0], [200.0, 0.0, 9.0]])
    scan_context = ScanContext(ScanContextConfig(height_offset=0.5))
    context = scan_context.describe(PointCloud(xyz)).reshape(20, 60)
    assert context[2, 0] == pytest.approx(3.5)
    assert context[12, 30] == pytest.approx(2.5)
    assert np.count_nonzero(context) == 2


def test_a_point_without_coordinates_is_left_out():
    xyz = np.array([[10.0, 0.1, 1.0], [np.nan, 0.1, 5.0], [10.0, 0.1, np.inf]])
    assert ScanContext().describe(PointCloud(xyz)).max() == pytest.approx(1.27)


def test_distances_and_yaws_are_those_of_the_formula(rng):
    contexts = sparse_contexts(rng, 30)
    scan_context = ScanContext()
    rows = np.stack([scan_context.row(context.ravel()) for context in contexts])
    query = sparse_contexts(rng, 1)[0]
    distances, yaws = scan_context.compare(scan_context.row(query.ravel()), rows)
    for context, distance, yaw in zip(contexts, distances, yaws, strict=True):
        expected, shift = paper_distance(query, context)
        assert distance == pytest.approx(expected, abs=1e-5)
        assert np.cos(yaw - 2 * np.pi * shift / 60) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize('sectors_turned', [0, 1, 17, 30, 59])
def test_a_turn_by_whole_sectors_is_found_exactly(rng, sectors_turned):
    match = points_in_sector_centres(rng, 3000)
    yaw = 2 * np.pi * sectors_turned / 60
    # The query's vehicle is turned by yaw, so its points turn the other way.
    query = turned(match, -yaw)
    scan_context = ScanContext()
    row = scan_context.row(scan_context.describe(PointCloud(match)))
    distance, found = scan_context.compare(
        scan_context.row(scan_context.describe(PointCloud(query))), row[None]
    )
    assert distance[0] == pytest.approx(0.0, abs=1e-5)
    assert np.cos(found[0] - yaw) == pytest.approx(1.0, abs=1e-6)


def test_the_shortlist_holds_the_nearest_ring_keys(rng):
    contexts = sparse_contexts(rng, 40)
    contexts[7] = np.roll(contexts[0], 11, axis=1)
    whole, short = ScanContext(), ScanContext(ScanContextConfig(shortlist=5))
    rows = np.stack([whole.row(context.ravel()) for context in contexts])
    all_distances, all_yaws = whole.compare(rows[0], rows)
    distances, yaws = short.compare(rows[0], rows)
    keys = np.mean(contexts > 0, axis=2)
    nearest = np.argsort(np.linalg.norm(keys - keys[0], axis=1))[:5]
    assert set(np.flatnonzero(np.isfinite(distances))) == set(nearest)
    assert {0, 7} <= set(nearest)
    np.testing.assert_allclose(distances[nearest], all_distances[nearest], atol=1e-6)
    np.testing.assert_allclose(yaws[nearest], all_yaws[nearest])


def test_nothing_in_common_is_as_far_as_it_gets():
    scan_context = ScanContext()
    empty = scan_context.row(np.zeros(1200, np.float32))
    distance, _ = scan_context.compare(empty, empty[None])
    assert distance[0] == pytest.approx(1.0)


def test_a_descriptor_of_another_shape_is_refused():
    with pytest.raises(DataError, match='1200 numbers, got 256'):
        ScanContext().row(np.zeros(256, np.float32))


@pytest.fixture
def rng():
    return np.random.default_rng(4)
