"""Hold a LiDAR sweep the way every core takes it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError

_FIRST_MOVING = 252  # SemanticKITTI: 252 to 259 are what 10 to 49 are, but moving


@dataclass(frozen=True)
class PointCloud:
    """Points of one sweep in one frame.

    Attributes:
        xyz: [N x 3] float32, metres.
        intensity: [N] float32 as the sensor gives it (KITTI: 0..1), or None.
        time_s: [N] float32, seconds after the sweep's stamp (negative before it), or None where the
            sensor does not say; never invented.
        label: [N] uint16, what a point lies on by SemanticKITTI's numbers (252 to 259 move), or
            None where nobody says it. Only data sets and simulators do.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32] | None = None
    time_s: NDArray[np.float32] | None = None
    label: NDArray[np.uint16] | None = None

    def __post_init__(self) -> None:
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise DataError(f'points must have the shape N x 3, got {self.xyz.shape}')
        for name in ('intensity', 'time_s', 'label'):
            values = getattr(self, name)
            if values is not None and values.shape != (len(self.xyz),):
                raise DataError(
                    f'{name} must have one value for each of the {len(self.xyz)} points, '
                    f'got the shape {values.shape}'
                )

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, mask_or_index: NDArray[Any]) -> 'PointCloud':
        """Return the chosen points with their intensity, time and label."""
        return PointCloud(
            self.xyz[mask_or_index],
            None if self.intensity is None else self.intensity[mask_or_index],
            None if self.time_s is None else self.time_s[mask_or_index],
            None if self.label is None else self.label[mask_or_index],
        )

    @property
    def moving(self) -> NDArray[np.bool_] | None:
        """Whether each point [N] lies on something that moves, None where there are no labels."""
        return None if self.label is None else self.label >= _FIRST_MOVING

    def finite(self) -> 'PointCloud':
        """Return the points without NaN or infinite coordinates (drivers mark no return so)."""
        finite = np.isfinite(self.xyz)
        # Row by row is slow, and nearly all sweeps are whole.
        return self if finite.all() else self.select(np.asarray(finite.all(axis=1)))

    def within(self, min_range: float, max_range: float) -> 'PointCloud':
        """Return the points whose range lies in the interval, metres."""
        squared = np.einsum('ij,ij->i', self.xyz, self.xyz)
        return self.select((squared >= min_range**2) & (squared <= max_range**2))

    def transformed(self, T_a_b: se3.Array) -> 'PointCloud':
        """Return the cloud taken from frame b to frame a."""
        xyz = se3.transform_points(T_a_b, self.xyz).astype(np.float32)
        return replace(self, xyz=xyz)


def voxel_first(xyz: NDArray[np.floating], voxel_size: float) -> NDArray[np.intp]:
    """Return the indices of the first point in each voxel, in input order.

    Keeping a measured point (not the voxel's mean) leaves thin structures where they are.
    """
    if not len(xyz):
        return np.empty(0, np.intp)
    # Axis by axis: the extremes of rows of three are slow.
    x, y, z = (np.floor(axis / voxel_size).astype(np.int64) for axis in xyz.T)
    y, z = y - y.min(), z - z.min()
    key = ((x - x.min()) * (y.max() + 1) + y) * (z.max() + 1) + z
    _, first = np.unique(key, return_index=True)
    return np.sort(first)
