"""Summarise a local map as one Gaussian a voxel: where its surfaces are and which way they face."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.se3 import Array

_OFFSET, _SPAN = 1 << 20, 1 << 21  # 21 bits an axis: voxels up to a million from the origin
# Upper triangle of a symmetric 3x3 matrix, and how it unfolds.
_ROWS, _COLUMNS = np.triu_indices(3)
_UNFOLD = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


@dataclass(frozen=True)
class Gaussians:
    """Points of K voxels, map frame, metres.

    Attributes:
        count: [K] points.
        mean: [K x 3].
        variance: [K x 3] along the axes, the smallest first.
        axes: [K x 3 x 3] unit eigenvectors of the covariance, one a column.
    """

    count: Array
    mean: Array
    variance: Array
    axes: Array


class VoxelGaussians:
    """Keep the count, mean and covariance of the points in each voxel around the sensor.

    The map of the normal distributions transform (Biber and Strasser, IROS 2003). Voxels that hold
    `full_at` points take no more, so that, like KISS-ICP's map, they stay where they were first
    seen; voxels farther than `max_range` are forgotten.
    """

    def __init__(self, voxel_size: float, max_range: float, full_at: int = 40) -> None:
        """Start empty; sizes in metres."""
        self.voxel_size, self.max_range, self.full_at = voxel_size, max_range, full_at
        # Sorted, and the slot of each: arrays are searched several times as fast as a dict.
        self._keys, self._slot = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._free: list[int] = []
        self._count = np.zeros(0)
        # Per slot: the voxel's corner, and the sums of the points' offsets and their products.
        self._corner, self._sum = np.zeros((0, 3)), np.zeros((0, 3))
        self._moment = np.zeros((0, 6))
        # What `gaussians` makes of them, where `_fresh`: registration asks again and again.
        self._fresh = np.zeros(0, bool)
        self._variance, self._axes = np.zeros((0, 3)), np.zeros((0, 3, 3))

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, points: Array, origin: Array) -> None:
        """Take in points [N x 3] of the map frame and forget voxels too far from `origin` [3]."""
        cells = np.floor(points / self.voxel_size)
        keys, point_key = np.unique(_pack(cells), return_inverse=True)
        slots = self._slots(keys)
        self._open(keys[slots < 0], slots)
        point_slot = slots[point_key]
        use = self._count[point_slot] < self.full_at
        self._fresh[point_slot[use]] = False
        point_slot, corner = point_slot[use], cells[use] * self.voxel_size
        # Offsets from the voxel's corner: small numbers, so that the moments do not cancel.
        offset = points[use] - corner
        size = len(self._count)
        self._count += np.bincount(point_slot, minlength=size)
        for axis in range(3):
            self._sum[:, axis] += np.bincount(point_slot, offset[:, axis], size)
        for entry, (row, column) in enumerate(zip(_ROWS, _COLUMNS, strict=True)):
            product = offset[:, row] * offset[:, column]
            self._moment[:, entry] += np.bincount(point_slot, product, size)
        self._corner[point_slot] = corner
        self._forget(origin)

    def find(self, points: Array, min_points: int = 1) -> NDArray[np.int64]:
        """Return the slot [N] of each point's voxel, -1 where it holds fewer than `min_points`."""
        slots = self._slots(_pack(np.floor(points / self.voxel_size)))
        known = slots >= 0
        known[known] = self._count[slots[known]] >= min_points
        return np.where(known, slots, -1)

    def gaussians(self, slots: NDArray[np.int64]) -> Gaussians:
        """Return the Gaussians of the given voxels; each must hold at least two points."""
        self._refresh(np.unique(slots[~self._fresh[slots]]))
        count = self._count[slots]
        mean = self._sum[slots] / count[:, None] + self._corner[slots]
        return Gaussians(count, mean, self._variance[slots], self._axes[slots])

    def clear(self) -> None:
        """Forget everything."""
        self.__init__(self.voxel_size, self.max_range, self.full_at)  # type: ignore[misc]

    def _refresh(self, slots: NDArray[np.int64]) -> None:
        count = self._count[slots]
        mean = self._sum[slots] / count[:, None]
        moment = (self._moment[slots] / count[:, None])[:, _UNFOLD].reshape(-1, 3, 3)
        covariance = moment - mean[:, :, None] * mean[:, None, :]
        # Unbiased: a voxel of few points is no thinner than they can tell.
        covariance *= (count / (count - 1))[:, None, None]
        variance, self._axes[slots] = np.linalg.eigh(covariance)
        self._variance[slots] = np.maximum(variance, 0.0)
        self._fresh[slots] = True

    def _slots(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        if not len(self._keys):
            return np.full(len(keys), -1)
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        return np.where(self._keys[at] == keys, self._slot[at], -1)

    def _open(self, new_keys: NDArray[np.int64], slots: NDArray[np.int64]) -> None:
        """Give the new keys (sorted) slots, and write them where `slots` holds -1."""
        if len(self._free) < len(new_keys):
            self._grow(max(len(new_keys), len(self._count), 4096))
        kept = len(self._free) - len(new_keys)
        self._free, taken = self._free[:kept], self._free[kept:]
        at = np.searchsorted(self._keys, new_keys)
        self._keys = np.insert(self._keys, at, new_keys)
        self._slot = np.insert(self._slot, at, taken)
        slots[slots < 0] = taken

    def _grow(self, amount: int) -> None:
        old = len(self._count)
        self._count = np.concatenate([self._count, np.zeros(amount)])
        self._corner = np.concatenate([self._corner, np.zeros((amount, 3))])
        self._sum = np.concatenate([self._sum, np.zeros((amount, 3))])
        self._moment = np.concatenate([self._moment, np.zeros((amount, 6))])
        self._fresh = np.concatenate([self._fresh, np.zeros(amount, bool)])
        self._variance = np.concatenate([self._variance, np.zeros((amount, 3))])
        self._axes = np.concatenate([self._axes, np.zeros((amount, 3, 3))])
        self._free += range(old + amount - 1, old - 1, -1)

    def _forget(self, origin: Array) -> None:
        away = self._corner - origin
        squared = np.einsum('ij,ij->i', away, away)
        far = np.nonzero((self._count > 0) & (squared > self.max_range**2))[0]
        if not len(far):
            return
        keys = _pack(np.round(self._corner[far] / self.voxel_size))
        at = np.searchsorted(self._keys, keys)
        self._keys, self._slot = np.delete(self._keys, at), np.delete(self._slot, at)
        self._count[far], self._sum[far], self._moment[far] = 0.0, 0.0, 0.0
        self._fresh[far] = False
        self._free += far.tolist()


def _pack(cells: Array) -> NDArray[np.int64]:
    x, y, z = (cells.astype(np.int64) + _OFFSET).T
    packed: NDArray[np.int64] = (x * _SPAN + y) * _SPAN + z
    return packed
