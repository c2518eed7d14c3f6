import numpy as np
from scipy.spatial import cKDTree

from lcd_common.cloud import PointCloud
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud


def plane(count, side_m=60.0):
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform(-side_m, side_m, (count, 2)), np.zeros(count)])
    return xyz.astype(np.float32)


def test_kept_points_were_measured_and_every_place_keeps_one():
    xyz = plane(50_000)
    kept = reduce_cloud(PointCloud(xyz), ReductionConfig(voxel_size=2.0, max_points=100_000)).xyz
    assert cKDTree(xyz).query(kept)[0].max() == 0.0
    near = xyz[(np.linalg.norm(xyz, axis=1) > 2.5) & (np.linalg.norm(xyz, axis=1) < 80.0)]
    assert cKDTree(kept).query(near)[0].max() <= 2.0 * np.sqrt(2)


def test_memory_is_bounded():
    cloud = PointCloud(plane(200_000), np.zeros(200_000, np.float32), np.zeros(200_000, np.float32))
    reduced = reduce_cloud(cloud, ReductionConfig(max_points=5000))
    assert 3500 < len(reduced) <= 5000
    assert reduced.intensity is not None and reduced.time_s is None


def test_the_vehicle_far_and_missing_returns_are_dropped():
    xyz = np.array([[1, 0, 0], [10, 0, 0], [99, 0, 0], [np.nan, 0, 0]], np.float32)
    assert reduce_cloud(PointCloud(xyz), ReductionConfig()).xyz.tolist() == [[10.0, 0.0, 0.0]]


def test_an_empty_cloud_stays_empty():
    assert len(reduce_cloud(PointCloud(np.empty((0, 3), np.float32)), ReductionConfig())) == 0
