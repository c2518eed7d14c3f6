"""Turn sweeps into submaps: no ground, a fixed number of points, one scale (thesis 4.3.1).

Two scales are in use and weights of one do not serve the other:

- live sweeps of LiDARs that see all around keep a fixed metric scale (`SubmapMaker`), so that the
  size of a street tells streets apart; x forward, z up, the origin on the ground below the car;
- files of the PointNetVLAD benchmark come centred, scaled by their own spread and negated
  (`benchmark_normalised` does the same to other clouds).
"""

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.keypoints import above_ground

_FIRST_M = 0.2  # voxels of the first thinning; no leaf is ever finer than that
_LEAF_STEPS = 7


@config
class SubmapConfig:
    """How sweeps become submaps; networks work on what they were trained on."""

    points: int = setting(4096, 'P: points of a submap', low=64)
    reach: float = setting(
        50.0,
        'what is farther away along x or y is left out; this far is 1 in the units of a submap',
        unit='m',
        low=5.0,
        high=200.0,
    )
    near: float = setting(2.5, 'what is nearer is the car itself', unit='m', low=0.0)
    ground: float = setting(
        0.4,
        'points less high above the lowest point around are ground; 0 keeps them',
        unit='m',
        low=0.0,
    )
    top: float = setting(30.0, 'what is higher is left out', unit='m', low=1.0)
    fewest: int = setting(
        200, 'points above the ground below which there is no submap', low=1
    )  # a covered sensor, an empty field

    @property
    def scale(self) -> float:
        """Units of a submap in a metre."""
        return 1.0 / self.reach


class SubmapMaker:
    """Make submaps of sweeps; the same sweep gives the same submap."""

    def __init__(self, settings: SubmapConfig | None = None) -> None:
        self.settings = settings or SubmapConfig()

    def make(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return a submap [P x 3]: metres times `settings.scale`, base frame.

        Args:
            cloud: base frame, metres, z = 0 on the ground below the sensor.

        Raises:
            DataError: too few points are left without the ground.
        """
        s = self.settings
        xyz = self._seen(cloud.xyz)
        if s.ground > 0.0:
            xyz = xyz[above_ground(torch.from_numpy(xyz), s.ground).numpy()]
        if len(xyz) < s.fewest:
            raise DataError(
                f'expected at least {s.fewest} points above the ground within {s.reach:g} m, got '
                f'{len(xyz)} of {len(cloud)}; is the sensor covered, the mounting missing?'
            )
        return thinned(xyz, s.points) * np.float32(s.scale)

    def _seen(self, xyz: NDArray[np.float32]) -> NDArray[np.float32]:
        s = self.settings
        radius = np.hypot(xyz[:, 0], xyz[:, 1])
        # Echoes from below the road would pass for the ground and leave the road standing.
        lowest = -1.0 - 0.1 * radius
        inside = (np.abs(xyz[:, :2]) < s.reach).all(1) & (radius >= s.near)  # NaN is not inside
        inside &= (xyz[:, 2] < s.top) & (xyz[:, 2] > lowest)
        return np.ascontiguousarray(xyz[inside], np.float32)


def thinned(xyz: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return exactly `count` points [count x 3]: means of cells, then points drawn at random.

    As the benchmark's script: the finest cells that give at most `count` points, the rest filled up
    from the cloud. Cells' order is that of their coordinates; what is drawn is always the same.
    """
    rng = np.random.default_rng(len(xyz))
    fine = xyz[voxel_first(xyz, _FIRST_M)]
    if len(fine) <= count:
        means = fine
    else:
        low, high = _FIRST_M, 8.0
        for _ in range(_LEAF_STEPS):
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if _cells(fine, middle) <= count else (middle, high)
        means = _means(fine, high)
        if len(means) > count:
            means = means[rng.choice(len(means), count, replace=False)]
    missing = count - len(means)
    if not missing:
        return means
    pool = fine if missing <= len(fine) else xyz
    extra = pool[rng.choice(len(pool), missing, replace=missing > len(pool))]
    return np.concatenate([means, extra]).astype(np.float32)


def benchmark_normalised(xyz: NDArray[np.floating], count: int = 4096) -> NDArray[np.float32]:
    """Return points [count x 3] in the benchmark's units (generate_submaps.m of PointNetVLAD).

    Centred on the mean, scaled so that the mean distance to it is 0.5, and negated; points outside
    of [-1, 1] give way to others drawn from inside. The metric scale is lost.

    Raises:
        DataError: there are no two different points.
    """
    points = np.asarray(xyz, np.float64)
    points = points - points.mean(axis=0) if len(points) else points
    spread = float(np.linalg.norm(points, axis=1).mean()) if len(points) else 0.0
    if not spread > 0.0:
        raise DataError(f'expected a cloud of different points, got {len(points)} equal or none')
    points *= -0.5 / spread
    inside = points[(np.abs(points) <= 1.0).all(axis=1)]
    rng = np.random.default_rng(len(points))
    if len(inside) >= count:
        inside = inside[np.sort(rng.choice(len(inside), count, replace=False))]
    else:
        inside = np.concatenate([inside, inside[rng.choice(len(inside), count - len(inside))]])
    return inside.astype(np.float32)


def _keys(xyz: NDArray[np.float32], cell_m: float) -> NDArray[np.int64]:
    at = np.floor(xyz / cell_m).astype(np.int64) + (1 << 20)
    return np.asarray((at[:, 0] << 42) + (at[:, 1] << 21) + at[:, 2])


def _cells(xyz: NDArray[np.float32], cell_m: float) -> int:
    return len(np.unique(_keys(xyz, cell_m)))


def _means(xyz: NDArray[np.float32], cell_m: float) -> NDArray[np.float32]:
    _, cell, count = np.unique(_keys(xyz, cell_m), return_inverse=True, return_counts=True)
    sums = [np.bincount(cell, xyz[:, axis], len(count)) for axis in range(3)]
    return (np.stack(sums, 1) / count[:, None]).astype(np.float32)
