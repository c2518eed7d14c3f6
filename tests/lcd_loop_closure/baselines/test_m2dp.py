"""M2DP against its definition, counted point by point, and under rotations."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.baselines.m2dp import M2dp, M2dpConfig


def building(seed: int, count: int = 4000) -> np.ndarray:
    """Points on a lopsided block and its surroundings: three different axes, none symmetric."""
    rng = np.random.default_rng(seed)
    ground = rng.exponential([25.0, 9.0, 0.1], (count, 3))
    walls = rng.uniform([0, 0, 0], [20.0, 3.0, rng.uniform(4, 12)], (count // 2, 3))
    return np.vstack([ground, walls + rng.uniform(0, 20, 3) * [1, 1, 0]])


def counted(aligned: np.ndarray, azimuth: float, elevation: float, circles: int, sectors: int):
    """Share of the points in each bin of one plane, as the paper says it."""
    normal = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    first = np.array([1.0, 0, 0]) - normal[0] * normal
    first /= np.linalg.norm(first)
    second = np.cross(normal, first)
    reach = max(np.linalg.norm(p) for p in aligned)
    bins = np.zeros((circles, sectors))
    for p in aligned:
        flat = p - (p @ normal) * normal
        angle = math.atan2(flat @ second, flat @ first) + math.pi
        circle = sum(np.linalg.norm(flat) >= reach * (k / circles) ** 2 for k in range(1, circles))
        bins[circle, min(int(angle / (2 * math.pi) * sectors), sectors - 1)] += 1
    return bins.ravel() / len(aligned)


def test_the_signature_is_that_of_the_definition():
    xyz = building(0, 300)
    m2dp = M2dp(M2dpConfig(azimuths=2, elevations=3, circles=4, sectors=6, axis_signs='largest'))
    centred = xyz - xyz.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    axes = np.array([a * np.sign(a[np.argmax(np.abs(a))]) for a in axes])
    axes[1] = np.cross(axes[2], axes[0])
    planes = [(a, e) for a in (-np.pi / 2, np.pi / 2) for e in (0.0, np.pi / 4, np.pi / 2)]
    expected = [counted(centred @ axes.T, a, e, 4, 6) for a, e in planes]
    np.testing.assert_allclose(m2dp.signature(xyz), expected, atol=1e-12)


def test_a_descriptor_is_two_unit_vectors_of_the_best_rank_one_matrix():
    xyz, m2dp = building(1), M2dp()
    descriptor = m2dp.describe(PointCloud(xyz.astype(np.float32)))
    assert descriptor.shape == (192,) and m2dp.length == m2dp.row_length == 192
    planes, bins = descriptor[:64].astype(float), descriptor[64:].astype(float)
    assert np.linalg.norm(planes) == pytest.approx(1.0, abs=1e-6)
    assert np.linalg.norm(bins) == pytest.approx(1.0, abs=1e-6)
    assert descriptor.min() >= 0.0
    A = m2dp.signature(xyz.astype(np.float32).astype(float))
    largest = np.sqrt(np.linalg.eigvalsh(A @ A.T)[-1])
    assert planes @ A @ bins == pytest.approx(largest, rel=1e-5)


@pytest.mark.parametrize('seed', range(5))
def test_a_moved_and_turned_cloud_has_the_same_descriptor(seed):
    rng, m2dp = np.random.default_rng(seed), M2dp()
    xyz = building(2)
    moved = xyz @ Rotation.random(rng=rng).as_matrix().T + rng.uniform(-50, 50, 3)
    others = [m2dp.describe(PointCloud(building(k).astype(np.float32))) for k in (3, 4)]
    rows = np.array([m2dp.describe(PointCloud(moved.astype(np.float32))), *others])
    distance, yaw = m2dp.compare(m2dp.describe(PointCloud(xyz.astype(np.float32))), rows)
    assert yaw is None
    assert distance[0] < 0.02
    assert distance[1:].min() > 3 * distance[0]


def test_signs_by_the_largest_coordinate_do_not_survive_a_turn():
    """Why M2DP fails on reverse loops in the thesis, and why it is not the default here."""
    xyz = building(2)
    back = xyz * [-1.0, -1.0, 1.0]
    for signs, same in (('skewness', True), ('largest', False)):
        m2dp = M2dp(M2dpConfig(axis_signs=signs))
        a, b = (m2dp.describe(PointCloud(x.astype(np.float32))) for x in (xyz, back))
        assert (np.linalg.norm(a - b) < 0.02) == same


def test_too_few_points_make_zeros_and_another_length_is_refused():
    m2dp = M2dp()
    lost = np.full((5, 3), np.nan, np.float32)
    assert not m2dp.describe(PointCloud(lost)).any()
    with pytest.raises(DataError, match='192 numbers'):
        m2dp.row(np.zeros(10, np.float32))
