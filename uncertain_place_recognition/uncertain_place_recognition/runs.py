"""Hold one drive as submaps with true poses: what training, calibration and evaluation read."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError

if TYPE_CHECKING:
    from lcd_loop_closure.evaluation.sweep_store import StoredSweeps

MakeSubmap = Callable[[PointCloud], NDArray[np.float32]]
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SubmapRun:
    """Submaps of one drive, in order.

    Attributes:
        name: of the run.
        world: name of the frame of the poses; runs of one world can be searched in one another.
        stamps_ns: [N] int64, increasing.
        T_world_base: [N x 4 x 4] true poses, metres.
        points: [N x P x 3] float16, in the units of the submap maker.
        facts: how they were made, for people and cards.
    """

    name: str
    world: str
    stamps_ns: NDArray[np.int64]
    T_world_base: se3.Array
    points: NDArray[np.float16]
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        number = len(self.stamps_ns)
        if self.T_world_base.shape != (number, 4, 4):
            raise DataError(
                f'run {self.name}: expected {number} poses 4 x 4, got the shape '
                f'{self.T_world_base.shape}'
            )
        if self.points.ndim != 3 or self.points.shape[::2] != (number, 3):
            raise DataError(
                f'run {self.name}: expected {number} submaps P x 3, got the shape '
                f'{self.points.shape}'
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> se3.Array:
        """Positions [N x 2] in the world's plane, metres: heights of runs need not agree."""
        return self.T_world_base[:, :2, 3]

    @property
    def length_m(self) -> float:
        """Path length, metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def select(self, chosen: NDArray[Any] | slice) -> 'SubmapRun':
        """Return some of the submaps."""
        return SubmapRun(
            self.name,
            self.world,
            self.stamps_ns[chosen],
            self.T_world_base[chosen],
            self.points[chosen],
            self.facts,
        )

    def save(self, path: Path) -> None:
        """Write an .npz file (numbers and JSON alone); a crash leaves the file of before."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix('.part.npz')
        np.savez(
            part,
            stamps_ns=self.stamps_ns.astype(np.int64),
            T_world_base=self.T_world_base.astype(np.float64),
            points=self.points.astype(np.float16),
            facts=np.array(json.dumps({'name': self.name, 'world': self.world, **self.facts})),
        )
        part.replace(path)

    @staticmethod
    def load(path: Path) -> 'SubmapRun':
        """Read what `save` wrote.

        Raises:
            DataError: the file is no run.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                facts: dict[str, Any] = json.loads(str(file['facts']))
                name, world = facts.pop('name'), facts.pop('world')
                arrays = file['stamps_ns'], file['T_world_base'], file['points']
        except FileNotFoundError:
            raise
        except (OSError, KeyError, ValueError, EOFError) as error:
            raise DataError(
                f'{path} holds no run of submaps ({type(error).__name__}); expected an .npz file '
                'that make_submap_runs wrote'
            ) from None
        return SubmapRun(name, world, *arrays, facts)


def load_runs(paths: Sequence[Path]) -> list[SubmapRun]:
    """Read runs: files, and folders with files, in the order of names.

    Raises:
        DataError: a file is no run, or there is none at all.
    """
    files: list[Path] = []
    for path in paths:
        files += sorted(path.glob('*.npz')) if path.is_dir() else [path]
    if not files:
        raise DataError(
            f'no runs (*.npz) in {", ".join(map(str, paths)) or "no folder"}; make_submap_runs '
            'makes them'
        )
    return [SubmapRun.load(file) for file in files]


def run_of_clouds(
    name: str,
    world: str,
    stamps_ns: NDArray[np.int64],
    T_world_base: se3.Array,
    clouds: Iterable[PointCloud],
    make: MakeSubmap,
    facts: dict[str, Any] | None = None,
    progress: Progress = lambda done, total: None,
) -> SubmapRun:
    """Return a run of clouds that come one by one, base frame.

    Raises:
        DataError: no cloud gives a submap.
    """
    submaps: list[NDArray[np.float16]] = []
    kept: list[int] = []
    for number, cloud in enumerate(clouds):
        try:
            submaps.append(make(cloud).astype(np.float16))
            kept.append(number)
        except DataError:
            pass  # too few points: the sensor was covered
        progress(number + 1, len(stamps_ns))
    if not kept:
        raise DataError(f'{name}: no cloud has enough points above the ground for a submap')
    told = {**(facts or {}), 'dropped': len(stamps_ns) - len(kept)}
    at = np.array(kept)
    return SubmapRun(name, world, stamps_ns[at], T_world_base[at], np.array(submaps), told)


def run_of_sweeps(
    sweeps: 'StoredSweeps',
    make: MakeSubmap,
    world: str = '',
    progress: Progress = lambda done, total: None,
) -> SubmapRun:
    """Return a run of stored sweeps (`lcd_loop_closure.evaluation.sweep_store`).

    Args:
        sweeps: base frame.
        make: `SubmapMaker.make`.
        world: of their poses; empty: a world of their own, named after the drive.
        progress: told how many sweeps are done of how many there are.
    """
    clouds = (sweeps.cloud(k) for k in range(len(sweeps)))
    return run_of_clouds(
        sweeps.name,
        world or sweeps.name,
        sweeps.stamps_ns,
        sweeps.T_world_base,
        clouds,
        make,
        dict(sweeps.facts),
        progress,
    )
