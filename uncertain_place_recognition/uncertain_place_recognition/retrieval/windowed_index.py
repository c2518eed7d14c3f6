"""What all indices share: entries are checked, kept back for a while, saved and loaded."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import ConfigError, DataError, MapError
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.retrieval.descriptor_rows import (
    checked_descriptor,
    checked_metric,
)
from uncertain_place_recognition.retrieval.insertion_window import (
    Entry,
    InsertionConfig,
    InsertionWindow,
)
from uncertain_place_recognition.retrieval.place_index import Neighbours

VERSION = 1


class WindowedIndex(ABC):
    """An engine with an insertion window before it; engines say how to insert and to search."""

    def __init__(
        self, length: int, metric: str = 'cosine', window: InsertionConfig | None = None
    ) -> None:
        """Start empty, for descriptors of `length` numbers."""
        if length < 1:
            raise ConfigError(f'descriptors must have at least one number, got {length}')
        self.length = length
        self.metric = checked_metric(metric)
        self._window = InsertionWindow(window)

    @property
    @abstractmethod
    def searchable(self) -> int:
        """Entries that can be found: what counts as the database's size."""

    @abstractmethod
    def _insert(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        """Make entries [K], [K x length] searchable."""

    @abstractmethod
    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        """Return the k best, k at least 1."""

    @abstractmethod
    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return ids and rows of all searchable entries."""

    def __len__(self) -> int:
        return self.searchable + len(self._window)

    def note_poses(self, places: Iterable[Place]) -> None:  # noqa: B027 - most keep none
        """Note where places are, before they are added and when they move.

        Only an engine that shares the map keeps them, and raises MapError when it cannot.
        """

    def close(self) -> None:  # noqa: B027 - most hold nothing
        """Let go of a folder or a connection, where the engine has one."""

    def add(
        self, place_id: int, descriptor: NDArray[np.floating], stamp_ns: int | None = None
    ) -> None:
        """Take in a descriptor [length]; with a stamp it waits until the delay is over.

        Raises:
            DataError: it has another length or is not finite.
        """
        row = checked_descriptor(descriptor, self.length)
        self._insert_entries(self._window.push(Entry(int(place_id), row, stamp_ns)))

    def add_many(self, place_id: NDArray[np.integer], descriptors: NDArray[np.floating]) -> None:
        """Take in entries [K], [K x length] of an earlier drive; they are found at once."""
        ids, rows = self._checked(place_id, descriptors)
        if len(ids):
            self._insert(ids, rows)

    def _checked(
        self, place_id: NDArray[np.integer], descriptors: NDArray[np.floating]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        ids = np.asarray(place_id, np.int64).ravel()
        rows = np.asarray(descriptors, np.float32)
        if rows.shape != (len(ids), self.length):
            raise DataError(
                f'expected {len(ids)} descriptors of {self.length} numbers, got the shape '
                f'{rows.shape}; was the map made with another ensemble?'
            )
        if not np.isfinite(rows).all():
            raise DataError('expected finite numbers in descriptors, got NaN or infinity')
        return ids, rows

    def search(
        self,
        descriptor: NDArray[np.floating],
        k: int,
        stamp_ns: int | None = None,
        near: NDArray[np.float64] | None = None,
    ) -> Neighbours:
        """Return up to k places, best first; `stamp_ns` is now, None leaves waiting ones out.

        An engine that divides the map by place may look only `near` [2 or 3], metres in the map.

        Raises:
            DataError: the descriptor has another length or is not finite.
        """
        row = checked_descriptor(descriptor, self.length)
        self._insert_entries(self._window.release(stamp_ns))
        if k < 1 or not self.searchable:
            nothing = np.empty(0, np.float32)
            return Neighbours(np.empty(0, np.int64), nothing, nothing)
        return self._nearest(row, k)

    def save(self, path: Path) -> None:
        """Write all entries, waiting ones too, as .npz; a crash leaves the file of before."""
        ids, rows = self._entries()
        waiting = self._window.waiting
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix('.part.npz')
        np.savez(
            part,
            version=np.array(VERSION),
            metric=np.array(self.metric),
            place_id=np.concatenate([ids, np.array([e.place_id for e in waiting], np.int64)]),
            descriptors=np.concatenate(
                [rows, np.reshape([e.descriptor for e in waiting], (-1, self.length))]
            ).astype(np.float32),
        )
        part.replace(path)

    def load(self, path: Path) -> None:
        """Take in what `save` of any index wrote, beside what there is; all are found at once.

        Raises:
            MapError: the file is none, or of another metric or length.
        """
        self.add_many(*self.read(path))

    def read(self, path: Path) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return ids [K] and rows [K x length] that `save` wrote, without taking them in.

        Raises:
            MapError: the file is none, or of another metric or length.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                version, metric = int(file['version']), str(file['metric'])
                ids, rows = file['place_id'], file['descriptors']
        except FileNotFoundError:
            raise
        except (OSError, KeyError, ValueError, EOFError) as error:
            raise MapError(f'{path} holds no index of places ({error})') from None
        if version != VERSION:
            raise MapError(f'{path}: expected version {VERSION}, got {version}; save it again')
        if metric != self.metric:
            raise MapError(f'{path} ranks by {metric}, this index by {self.metric}; use {metric}')
        try:
            return self._checked(ids, rows)
        except DataError as error:
            raise MapError(f'{path}: {error}') from None

    def _insert_entries(self, entries: Sequence[Entry]) -> None:
        if entries:
            self._insert(
                np.array([entry.place_id for entry in entries], np.int64),
                np.stack([entry.descriptor for entry in entries]),
            )
