"""Hold what ensembles made of one drive's submaps: all that calibration and evaluation need."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError


@dataclass(frozen=True)
class EmbeddedRun:
    """Member embeddings of the submaps of one drive, in order.

    Attributes:
        name: of the run.
        world: name of the frame of the positions; runs of one world are searched in one another.
        stamps_ns: [N] int64, increasing.
        positions: [N x 2] true, in the world's plane, metres.
        members: by the names of ensembles, embeddings [N x M x D] each; M = 1 for a single network.
        facts: how they were made.
    """

    name: str
    world: str
    stamps_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    members: dict[str, NDArray[np.float32]]
    facts: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        number = len(self.stamps_ns)
        if self.positions.shape != (number, 2):
            raise DataError(
                f'run {self.name}: expected {number} positions x y, got the shape '
                f'{self.positions.shape}'
            )
        for name, whole in self.members.items():
            if whole.ndim != 3 or len(whole) != number or not whole.shape[1]:
                raise DataError(
                    f'run {self.name}, {name}: expected {number} x members x numbers, got the '
                    f'shape {whole.shape}'
                )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def of(self, ensemble: str) -> NDArray[np.float32]:
        """Return the embeddings [N x M x D] of an ensemble; raises DataError if there are none."""
        if ensemble not in self.members:
            raise DataError(
                f'run {self.name} has no embeddings {ensemble!r}; it has '
                f'{", ".join(self.members) or "none"}'
            )
        return self.members[ensemble]

    def save(self, path: Path) -> None:
        """Write an .npz file (numbers and JSON alone); a crash leaves the file of before."""
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix('.part.npz')
        arrays = {f'members_{name}': whole for name, whole in self.members.items()}
        facts = json.dumps({'name': self.name, 'world': self.world, **self.facts})
        np.savez(
            part,
            stamps_ns=self.stamps_ns,
            positions=self.positions,
            facts=np.array(facts),
            **arrays,  # type: ignore[arg-type]
        )
        part.replace(path)

    @staticmethod
    def load(path: Path) -> 'EmbeddedRun':
        """Read what `save` wrote.

        Raises:
            DataError: the file holds no embedded run.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                facts: dict[str, Any] = json.loads(str(file['facts']))
                name, world = facts.pop('name'), facts.pop('world')
                stamps_ns, positions = file['stamps_ns'], file['positions']
                members = {
                    key.removeprefix('members_'): file[key]
                    for key in file.files
                    if key.startswith('members_')
                }
        except FileNotFoundError:
            raise
        except (OSError, KeyError, ValueError, EOFError) as error:
            raise DataError(
                f'{path} holds no embedded run ({error}); expected an .npz file that '
                'evaluate_place_recognition --save-embeddings wrote'
            ) from None
        return EmbeddedRun(name, world, stamps_ns, positions, members, facts)


def is_embedded(path: Path) -> bool:
    """Tell whether a file holds embeddings rather than submaps; False when it is unreadable."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return 'positions' in file.files
    except (OSError, ValueError, EOFError):
        return False


def ordered_pairs(runs: Sequence[EmbeddedRun]) -> list[tuple[int, int]]:
    """Return (database, queries) of every ordered pair of different runs of one world.

    Raises:
        DataError: no two runs are of one world.
    """
    pairs = [
        (m, n)
        for m, database in enumerate(runs)
        for n, queries in enumerate(runs)
        if m != n and database.world == queries.world
    ]
    if not pairs:
        worlds = ', '.join(f'{run.name} in {run.world}' for run in runs)
        raise DataError(f'no two runs are of one world: {worlds or "no runs"}')
    return pairs
