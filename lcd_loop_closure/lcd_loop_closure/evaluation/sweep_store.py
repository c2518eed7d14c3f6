"""Keep the sweeps of a drive in a folder, so that every method sees the same ones, read once."""

import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.errors import DataError
from lcd_loop_closure.compact_cloud import CompactCloud, compact

# One measured point is kept for each voxel of this size: a third of a 64-beam sweep goes, all of it
# next to the car where points lie closer than any descriptor or registration here resolves.
VOXEL_M = 0.1
_INDEX, _STEPS, _INTENSITY = 'index.npz', 'steps.int16', 'intensity.float16'


class StoredSweeps:
    """Sweeps of a drive, base frame; memory-mapped.

    Attributes:
        name: of the drive.
        stamps_ns: [N].
        T_world_base: [N x 4 x 4] true poses.
        facts: what was told when they were written.
    """

    def __init__(self, folder: Path, chosen: NDArray[np.intp] | None = None) -> None:
        """Open a folder; `chosen` are the sweeps to show.

        Raises:
            DataError: there is none, or it is not complete.
        """
        self.folder = folder
        try:
            with np.load(folder / _INDEX) as index:
                self._begin, self._step_m = index['begin'], index['step_m']
                stamps, poses = index['stamps_ns'], index['T_world_base']
                self._lit: NDArray[np.bool_] = index['has_intensity']
                self.facts: dict[str, Any] = json.loads(str(index['facts']))
        except (OSError, KeyError, ValueError) as error:
            raise DataError(
                f'{folder} holds no complete set of sweeps ({error}); delete it to make it anew'
            ) from None
        self._chosen = np.arange(len(stamps)) if chosen is None else chosen
        self.stamps_ns: NDArray[np.int64] = stamps[self._chosen]
        self.T_world_base: se3.Array = poses[self._chosen]
        self.name: str = self.facts['name']
        total = int(self._begin[-1])
        # A file of no length cannot be mapped.
        self._steps = _mapped(folder / _STEPS, np.int16, (total, 3))
        self._intensity = _mapped(folder / _INTENSITY, np.float16, (total,))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame; without intensity where the sensor gave none."""
        k = int(self._chosen[number])
        part = slice(int(self._begin[k]), int(self._begin[k + 1]))
        intensity = np.asarray(self._intensity[part]) if self._lit[k] else None
        steps = np.asarray(self._steps[part])
        return CompactCloud(steps, float(self._step_m[k]), intensity).cloud()

    def select(self, chosen: NDArray[np.intp]) -> 'StoredSweeps':
        """Return some of the sweeps, files shared."""
        return StoredSweeps(self.folder, self._chosen[chosen])

    def with_poses(self, T_world_base: se3.Array) -> 'StoredSweeps':
        """Return the sweeps with other true poses."""
        other = StoredSweeps(self.folder, self._chosen)
        other.T_world_base = T_world_base
        return other


class SweepWriter:
    """Write sweeps one by one; the folder counts as complete when the block ends well."""

    def __init__(self, folder: Path, name: str, facts: dict[str, Any] | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _INDEX).unlink(missing_ok=True)
        self.folder, self._facts = folder, {**(facts or {}), 'name': name}
        self._steps = (folder / _STEPS).open('wb')
        self._intensity = (folder / _INTENSITY).open('wb')
        self._begin, self._step_m, self._lit = [0], list[float](), list[bool]()
        self._stamps, self._poses = list[int](), list[se3.Array]()

    def add(self, stamp_ns: int, cloud: PointCloud, T_world_base: se3.Array) -> None:
        """Add a sweep, base frame."""
        cloud = cloud.finite()
        small = compact(cloud.select(voxel_first(cloud.xyz, VOXEL_M)))
        intensity = small.intensity
        self._lit.append(intensity is not None)
        if intensity is None:
            intensity = np.zeros(len(small), np.float16)
        small.steps.tofile(self._steps)
        intensity.tofile(self._intensity)
        self._begin.append(self._begin[-1] + len(small))
        self._step_m.append(small.step_m)
        self._stamps.append(stamp_ns)
        self._poses.append(np.asarray(T_world_base, np.float64))

    def __len__(self) -> int:
        return len(self._stamps)

    def __enter__(self) -> 'SweepWriter':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._steps.close()
        self._intensity.close()
        if kind is not None:
            return
        part = self.folder / f'part_{_INDEX}'
        np.savez(
            part,
            begin=np.array(self._begin, np.int64),
            step_m=np.array(self._step_m, np.float64),
            has_intensity=np.array(self._lit, bool),
            stamps_ns=np.array(self._stamps, np.int64),
            T_world_base=np.array(self._poses).reshape(-1, 4, 4),
            facts=np.array(json.dumps(self._facts)),
        )
        os.replace(part, self.folder / _INDEX)


def is_stored(folder: Path) -> bool:
    """Tell whether a folder holds a complete set of sweeps."""
    return (folder / _INDEX).is_file()


def _mapped(path: Path, kind: type[np.generic], shape: tuple[int, ...]) -> NDArray[Any]:
    if not shape[0]:
        return np.empty(shape, kind)
    try:
        return np.memmap(path, kind, 'r', shape=shape)
    except (OSError, ValueError) as error:
        raise DataError(f'{path} is cut short ({error}); delete its folder') from None
