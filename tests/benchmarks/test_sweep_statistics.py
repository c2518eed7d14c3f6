"""Statistics of sweeps, against shapes whose figures are known, and real sweeps with labels."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.sweep_statistics import (
    RANGE_EDGES_M,
    RingedSweep,
    compared,
    ground_points,
    statistics,
    total_variation,
)
from lcd_common.cloud import PointCloud

KITTI_00 = Path(__file__).parents[3] / 'shared/data/kitti_odometry/sequences/00'
GROUND = (40, 44, 48, 49, 60, 72)  # SemanticKITTI: road, parking, sidewalk, other, marking, terrain


def road(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    return np.column_stack([rng.uniform(-8, 8, (count, 2)), np.full(count, -1.73)])


def swept(xyz: np.ndarray, intensity: np.ndarray | None = None) -> RingedSweep:
    cloud = PointCloud(xyz.astype(np.float32), intensity)
    return RingedSweep(cloud, np.arange(len(xyz)) % 64)


def test_a_plane_is_planar_and_a_wire_linear():
    rng = np.random.default_rng(0)
    plane = statistics([swept(road(rng))])
    assert plane.planarity > 0.7 and plane.linearity < 0.25 and plane.ground_share == 1.0
    wire = np.column_stack([np.linspace(5, 25, 2000), np.zeros((2000, 2))])
    assert statistics([swept(wire)]).linearity > 0.99


def test_points_and_rings_are_counted():
    found = statistics([swept(road(np.random.default_rng(1), 6400))])
    assert found.points == 6400 and found.ring_mean == 100.0 and found.ring_std == 0.0
    assert found.range_share.sum() == pytest.approx(1.0)
    assert len(found.range_share) == len(RANGE_EDGES_M) - 1


def test_rings_of_points_in_order():
    azimuth = (np.arange(0.05, 2 * np.pi, 0.1) + np.zeros((64, 1))).ravel()
    xyz = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(len(azimuth))])
    ring = RingedSweep.in_order(PointCloud((10 * xyz).astype(np.float32))).ring
    np.testing.assert_array_equal(ring, np.repeat(np.arange(64), len(azimuth) // 64))


def test_walls_and_roofs_are_no_ground():
    rng = np.random.default_rng(2)
    wall = np.column_stack([np.full(500, 7.0), rng.uniform(-8, 8, 500), rng.uniform(-1.2, 4, 500)])
    roof = np.column_stack([rng.uniform(10, 14, 500), rng.uniform(-3, 3, 500), np.full(500, 4.0)])
    ground = ground_points(np.concatenate([road(rng), wall, roof]))
    assert ground[:6000].all() and not ground[6000:].any()


@pytest.mark.parametrize('scan', [52, 88, 850, 4501])
def test_ground_share_is_that_of_the_labels(scan):
    bin_file, labels = (
        KITTI_00 / folder / f'{scan:06d}.{end}'
        for folder, end in (('velodyne', 'bin'), ('labels', 'label'))
    )
    if not (bin_file.is_file() and labels.is_file()):
        pytest.skip('the labelled sweeps of KITTI 00 are not in ../shared/data')
    xyz = np.fromfile(bin_file, np.float32).reshape(-1, 4)[:, :3]
    truth = np.isin(np.fromfile(labels, np.uint32) & 0xFFFF, GROUND)
    assert abs(ground_points(xyz).mean() - truth.mean()) < 0.05


def test_distance_of_histograms():
    assert total_variation(np.array([0.5, 0.5]), np.array([0.5, 0.5])) == 0.0
    assert total_variation(np.array([1.0, 0.0]), np.array([0.0, 1.0])) == 1.0
    assert total_variation(np.array([0.7, 0.3]), np.array([0.5, 0.5])) == pytest.approx(0.2)


def test_comparison_has_every_entry_and_no_intensity_where_one_has_none():
    rng = np.random.default_rng(3)
    xyz = road(rng)
    bright = statistics([swept(xyz, np.full(len(xyz), 0.9, np.float32))])
    dark, blind = statistics([swept(xyz, np.zeros(len(xyz), np.float32))]), statistics([swept(xyz)])
    entries = compared(bright, dark)
    assert entries['points'] == {'real': 6000.0, 'simulated': 6000.0}
    assert entries['range_histogram_distance'] == 0.0
    assert entries['intensity_histogram_distance'] == 1.0
    assert compared(bright, blind)['intensity_histogram_distance'] is None
