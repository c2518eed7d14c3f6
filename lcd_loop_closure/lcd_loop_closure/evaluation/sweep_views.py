"""Sweeps of a drive as a sensor would see them whose view is partly blocked, or with a memory."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud, voxel_first


class Sweeps(Protocol):
    """Sweeps of a drive in the base frame with their true poses.

    Attributes:
        name: of the drive and the view, for files.
        T_world_base: [N x 4 x 4].
    """

    @property
    def name(self) -> str:
        """Of the drive and the view, for files."""

    @property
    def T_world_base(self) -> se3.Array:
        """True poses [N x 4 x 4]."""

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame."""


class SectorRemoved:
    """Every sweep without a sector of its own, at a heading drawn once for each scan.

    Thesis section 3.3.5: a random section is removed from each point cloud, so from both of a pair.
    """

    def __init__(self, sweeps: Sweeps, width_deg: float, seed: int = 0) -> None:
        self._sweeps, self._width = sweeps, np.radians(width_deg)
        rng = np.random.default_rng([seed, 29])
        self._middle = rng.uniform(-np.pi, np.pi, len(sweeps.T_world_base))
        self.name = f'{sweeps.name}_sector_{width_deg:g}_draw_{seed}'
        self.T_world_base = sweeps.T_world_base

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame."""
        return without_sector(
            self._sweeps.cloud(number), float(self._middle[number]), float(self._width)
        )


class RearBlocked:
    """Every sweep without a sector to the rear, as of MulRan's LiDAR behind its radar."""

    def __init__(self, sweeps: Sweeps, width_deg: float = 70.0) -> None:
        self._sweeps, self._width = sweeps, float(np.radians(width_deg))
        self.name = f'{sweeps.name}_rear_{width_deg:g}'
        self.T_world_base = sweeps.T_world_base

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame."""
        return without_sector(self._sweeps.cloud(number), np.pi, self._width)


class Aggregated:
    """Every sweep together with those of the last metres: a scan-to-map detector's input.

    The motion between the sweeps is taken from the reference, which odometry matches to
    centimetres over such a stretch.
    """

    def __init__(self, sweeps: Sweeps, behind_m: float = 20.0, step_m: float = 2.0) -> None:
        """Take sweeps every `step_m` of the `behind_m` of path before each."""
        self._sweeps, self._behind, self._step = sweeps, behind_m, step_m
        self.name = f'{sweeps.name}_behind_{behind_m:g}'
        self.T_world_base = sweeps.T_world_base
        steps = np.linalg.norm(np.diff(sweeps.T_world_base[:, :3, 3], axis=0), axis=1)
        self._travelled = np.concatenate([[0.0], np.cumsum(steps)])

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep with what was seen before it, base frame, a point for each 0.1 m."""
        T_now = se3.inverse(self.T_world_base[number])
        parts, at = [self._sweeps.cloud(number)], number
        for k in range(number - 1, -1, -1):
            if self._travelled[number] - self._travelled[k] > self._behind:
                break
            if self._travelled[at] - self._travelled[k] >= self._step:
                parts.append(self._sweeps.cloud(k).transformed(T_now @ self.T_world_base[k]))
                at = k
        intensity = None
        if all(part.intensity is not None for part in parts):
            intensity = np.concatenate([part.intensity for part in parts])
        whole = PointCloud(np.concatenate([part.xyz for part in parts]), intensity)
        return whole.select(voxel_first(whole.xyz, 0.1))


class Joined:
    """Sweeps of several drives through one world, one drive after the other."""

    def __init__(self, drives: Sequence[Sweeps], name: str) -> None:
        self._drives, self.name = drives, name
        self._begin = np.cumsum([0, *(len(drive.T_world_base) for drive in drives)])
        self.T_world_base = np.concatenate([drive.T_world_base for drive in drives])

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame."""
        drive = int(np.searchsorted(self._begin, number, side='right')) - 1
        return self._drives[drive].cloud(number - int(self._begin[drive]))


def without_sector(cloud: PointCloud, middle_rad: float, width_rad: float) -> PointCloud:
    """Return the points of a cloud outside a sector, seen from its origin."""
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    apart = np.abs((azimuth - middle_rad + np.pi) % (2.0 * np.pi) - np.pi)
    return cloud.select(apart > 0.5 * width_rad)
