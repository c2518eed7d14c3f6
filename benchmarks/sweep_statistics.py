"""Compare sweeps of a real LiDAR with simulated ones, figure by figure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common import se3
from lcd_common.cloud import PointCloud

RANGE_EDGES_M = np.arange(0.0, 82.0, 2.0)
INTENSITY_EDGES = np.linspace(0.0, 1.0, 21)
RINGS = 64
_NEIGHBOURS_M, _LEAST_NEIGHBOURS, _SAMPLES = 0.5, 8, 1500
_CELL_M, _GROUND_M, _CLIMB = 2.0, 0.25, 0.08


@dataclass(frozen=True)
class RingedSweep:
    """A sweep and the beam [N] that measured each point, top beam 0."""

    cloud: PointCloud
    ring: NDArray[np.integer]

    @classmethod
    def in_order(cls, cloud: PointCloud) -> 'RingedSweep':
        """Tell rings by the order of the points: KITTI's files hold them ring by ring.

        Each ring begins straight ahead and goes round once, counter-clockwise.
        """
        azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]) % (2 * np.pi)
        begins = np.diff(azimuth, prepend=azimuth[:1]) < -np.pi
        return cls(cloud, np.minimum(np.cumsum(begins), RINGS - 1))


@dataclass(frozen=True)
class SweepStatistics:
    """What is counted in a set of sweeps of one sensor.

    Attributes:
        points: of a sweep, mean.
        range_share: [R] of the points in each 2 m of range.
        ring_mean, ring_std: points per ring, and how much the rings of a sweep differ.
        ground_share: of the points that lie on the ground.
        linearity, planarity: medians over points of (s1 - s2) / s1 and (s2 - s3) / s1, s being the
            square roots of the eigenvalues of the covariance of the points within 0.5 m (Demantke
            2011).
        intensity_share: [I] of the points in each twentieth of the intensity; None without any.
    """

    points: float
    range_share: se3.Array
    ring_mean: float
    ring_std: float
    ground_share: float
    linearity: float
    planarity: float
    intensity_share: se3.Array | None


def statistics(sweeps: Sequence[RingedSweep]) -> SweepStatistics:
    """Count a set of at least one sweep, lidar frame (z up, the road about 1.73 m below)."""
    rng = np.random.default_rng(0)
    clouds = [sweep.cloud for sweep in sweeps]
    ranges = [np.linalg.norm(cloud.xyz, axis=1) for cloud in clouds]
    rings = np.array([np.bincount(sweep.ring, minlength=RINGS) for sweep in sweeps])
    shapes = np.concatenate([_shapes(cloud.xyz, rng) for cloud in clouds])
    ground = [ground_points(cloud.xyz).mean() for cloud in clouds]
    intensities = [c.intensity for c in clouds if c.intensity is not None]
    return SweepStatistics(
        float(np.mean([len(cloud) for cloud in clouds])),
        _shares(np.concatenate(ranges), RANGE_EDGES_M),
        float(rings.mean()),
        float(rings.std(axis=1).mean()),
        float(np.mean(ground)),
        float(np.median(shapes[:, 0])),
        float(np.median(shapes[:, 1])),
        _shares(np.concatenate(intensities), INTENSITY_EDGES) if intensities else None,
    )


def compared(
    real: SweepStatistics, simulated: SweepStatistics
) -> dict[str, float | dict[str, float] | None]:
    """Return an entry per statistic: both values, or the distance of two histograms.

    The distance is the total variation: the share of the points that would have to move to another
    bin, 0 for the same histogram and 1 for nothing in common.
    """
    entries: dict[str, float | dict[str, float] | None] = {
        name: {
            'real': round(getattr(real, name), 4),
            'simulated': round(getattr(simulated, name), 4),
        }
        for name in ('points', 'ring_mean', 'ring_std', 'ground_share', 'linearity', 'planarity')
    }
    entries['range_histogram_distance'] = total_variation(real.range_share, simulated.range_share)
    entries['intensity_histogram_distance'] = (
        None
        if real.intensity_share is None or simulated.intensity_share is None
        else total_variation(real.intensity_share, simulated.intensity_share)
    )
    return entries


def total_variation(one: se3.Array, other: se3.Array) -> float:
    """Return half the sum of the differences of two histograms of shares."""
    return round(0.5 * float(np.abs(one - other).sum()), 4)


def ground_points(xyz: np.ndarray) -> np.ndarray:
    """Return which points [N] lie on the ground: at most 0.25 m above the lowest around them.

    The lowest point of each 2 m cell is taken, lowered to what a slope of 8 % allows around its
    neighbours, so that a cell that sees only a wall or a roof has no ground of its own. Against
    SemanticKITTI's labels (sequence 00, four sweeps) the share is right within 0.04.
    """
    cell = np.floor(xyz[:, :2] / _CELL_M).astype(np.int64)
    keys, of = np.unique(cell, axis=0, return_inverse=True)
    lowest = np.full(len(keys), np.inf)
    np.minimum.at(lowest, of.ravel(), xyz[:, 2])
    # The car itself stands on the ground; from there it can only climb so fast.
    away = np.linalg.norm((keys + 0.5) * _CELL_M, axis=1)
    lowest = np.minimum(lowest, -1.73 + _CLIMB * away + 0.2)
    near = cKDTree(keys).query_ball_point(keys, 2.3)
    around = np.array([lowest[others].min() for others in near]) + 2.3 * _CELL_M * _CLIMB
    return np.asarray(xyz[:, 2] < np.minimum(lowest, around)[of.ravel()] + _GROUND_M)


def _shapes(xyz: np.ndarray, rng: np.random.Generator) -> se3.Array:
    """Return linearity and planarity [M x 2] of the neighbourhoods of random points."""
    tree = cKDTree(xyz)
    out = []
    for index in rng.choice(len(xyz), min(_SAMPLES, len(xyz)), replace=False):
        near = xyz[tree.query_ball_point(xyz[index], _NEIGHBOURS_M)]
        if len(near) < _LEAST_NEIGHBOURS:
            continue
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(near.T)), 0.0))[::-1]
        out.append([(spread[0] - spread[1]) / spread[0], (spread[1] - spread[2]) / spread[0]])
    return np.array(out).reshape(-1, 2)


def _shares(values: np.ndarray, edges: se3.Array) -> se3.Array:
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
    return np.asarray(counts / max(1, counts.sum()))
