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
        asking: [N] which submaps are queries; None: all. It is no part of the file.
        searched: whether the queries of others are searched in it. It is no part of the file.
    """

    name: str
    world: str
    stamps_ns: NDArray[np.int64]
    positions: NDArray[np.float64]
    members: dict[str, NDArray[np.float32]]
    facts: dict[str, Any] = field(default_factory=dict)
    asking: NDArray[np.bool_] | None = None
    searched: bool = True

    def __post_init__(self) -> None:
        number = len(self.stamps_ns)
        if self.positions.shape != (number, 2):
            raise DataError(
                f'run {self.name}: expected {number} positions x y, got the shape '
                f'{self.positions.shape}'
            )
        if self.asking is not None and self.asking.shape != (number,):
            raise DataError(
                f'run {self.name}: expected {number} flags of queries, got the shape '
                f'{self.asking.shape}'
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

    @property
    def asks(self) -> bool:
        """Whether any of its submaps is a query."""
        return self.asking is None or bool(self.asking.any())

    def queries(self) -> 'EmbeddedRun':
        """Return the submaps that are queries, as a run."""
        if self.asking is None:
            return self
        members = {name: whole[self.asking] for name, whole in self.members.items()}
        stamps_ns, positions = self.stamps_ns[self.asking], self.positions[self.asking]
        return EmbeddedRun(self.name, self.world, stamps_ns, positions, members, self.facts)

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

    Runs that are not searched are no databases, runs that do not ask no queries.

    Raises:
        DataError: no two runs are of one world, or none of them asks in another one.
    """
    pairs = [
        (m, n)
        for m, database in enumerate(runs)
        for n, queries in enumerate(runs)
        if m != n and database.world == queries.world
    ]
    worlds = ', '.join(f'{run.name} in {run.world}' for run in runs) or 'no runs'
    if not pairs:
        raise DataError(f'no two runs are of one world: {worlds}')
    pairs = [(m, n) for m, n in pairs if runs[m].searched and runs[n].asks]
    if not pairs:
        raise DataError(
            'no run with queries has a database of its world; databases: '
            f'{", ".join(f"{r.name} in {r.world}" for r in runs if r.searched) or "none"}; '
            f'queries: {", ".join(f"{r.name} in {r.world}" for r in runs if r.asks) or "none"}'
        )
    return pairs
