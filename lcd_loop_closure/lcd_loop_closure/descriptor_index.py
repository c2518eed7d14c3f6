"""Find the keyframes whose descriptors are most alike."""

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.local_features import LocalFeatures

if TYPE_CHECKING:
    from lcd_loop_closure.compact_search import CompactSearch


class Metric(Protocol):
    """How descriptors are compared: `ScanContext` turns columns, `Euclidean` does not."""

    @property
    def row_length(self) -> int:
        """Numbers that are stored for each descriptor."""

    @property
    def unit_length(self) -> bool:
        """Whether rows have unit length and are compared by their L2 distance."""

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what has to be stored of a descriptor."""

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return distances [N] and, where the metric knows it, the query's yaw in each match."""


class PlaceDescriptor(Metric, Protocol):
    """How sweeps are described and compared.

    `name` is what users call it; `length` counts the numbers of a descriptor.
    """

    name: str

    @property
    def max_distance(self) -> float:
        """Descriptors farther apart are of different places."""

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor [length] float32 of a sweep in the base frame."""

    def features(self, cloud: PointCloud) -> LocalFeatures | None:
        """Return keypoints that register a sweep; None where the descriptor has none."""


class Euclidean:
    """Compare fixed-length vectors by their L2 distance (LCDNet's descriptors, thesis 3.2)."""

    def __init__(self, length: int, *, unit_length: bool = False) -> None:
        """Compare vectors of `length` numbers, all of them of unit length where that is told."""
        self.row_length, self.unit_length = length, unit_length

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the descriptor; raises DataError on another length."""
        if descriptor.size != self.row_length:
            raise DataError(
                f'expected a descriptor of {self.row_length} numbers, got {descriptor.size}; '
                'was the map made with another descriptor?'
            )
        return np.asarray(descriptor, np.float32).ravel()

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], None]:
        """Return the distances [N]; a vector holds no yaw.

        |r - q|^2 = r^2 + q^2 - 2 r q: one product in place of a copy of all rows.
        """
        total = np.einsum('ij,ij->i', rows, rows) + query @ query
        squared = total - 2.0 * (rows @ query)
        # Of near ones the difference of large numbers leaves too few digits.
        near = squared < 0.05 * total
        squared[near] = np.square(rows[near] - query).sum(1)
        return np.sqrt(squared), None


@dataclass(frozen=True)
class Match:
    """A keyframe that looks alike.

    Attributes:
        id: of the keyframe.
        distance: of the descriptors, unit of the metric.
        yaw: heading of the query in the match, radians; None when the metric does not tell.
    """

    id: int
    distance: float
    yaw: float | None


class DescriptorIndex:
    """Search all descriptors exactly, except those of the recent past.

    Entries wait in a queue until the vehicle has travelled `delay_m` since they were added, so that
    it does not recognise the place where it is. The distance is that of odometry along the path:
    standing still or turning on the spot brings nothing in.
    """

    def __init__(self, metric: Metric, delay_m: float) -> None:
        self.metric = metric
        self.delay_m = delay_m
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._rows = _rows(self.metric)
        self._ids = np.empty(64, np.int64)
        self._waiting: deque[tuple[int, float, NDArray[np.float32]]] = deque()

    def __len__(self) -> int:
        return len(self._rows) + len(self._waiting)

    def add(self, id: int, descriptor: NDArray[np.float32], travelled_m: float) -> None:
        """Queue a descriptor met after `travelled_m` of path; minus infinity: enter it at once."""
        row = self.metric.row(descriptor)
        if travelled_m == -np.inf:
            self._insert(id, row)
        else:
            self._waiting.append((id, travelled_m, row))

    def nearest(
        self, descriptor: NDArray[np.float32], travelled_m: float, count: int
    ) -> list[Match]:
        """Return up to `count` matches that are old enough after `travelled_m`, nearest first."""
        while self._waiting and travelled_m - self._waiting[0][1] >= self.delay_m:
            id, _, row = self._waiting.popleft()
            self._insert(id, row)
        if not len(self._rows):
            return []
        numbers, distance, yaw = self._rows.search(self.metric.row(descriptor), count)
        return [
            Match(int(self._ids[n]), float(d), None if yaw is None else float(yaw[k]))
            for k, (n, d) in enumerate(zip(numbers, distance, strict=True))
            if np.isfinite(d)
        ]

    def remove(self, id: int) -> None:
        """Forget one keyframe; an unknown id is no error."""
        keep = np.flatnonzero(self._ids[: len(self._rows)] != id)
        if len(keep) < len(self._rows):
            self._rows.keep(keep)
            self._ids[: len(keep)] = self._ids[keep]
        self._waiting = deque(entry for entry in self._waiting if entry[0] != id)

    def _insert(self, id: int, row: NDArray[np.float32]) -> None:
        if len(self._rows) == len(self._ids):
            self._ids = np.concatenate([self._ids, np.empty_like(self._ids)])
        self._ids[len(self._rows)] = id
        self._rows.add(row)


class ComparedRows:
    """Rows that are all compared with a query, by any metric."""

    def __init__(self, metric: Metric) -> None:
        self._metric, self._size = metric, 0
        self._held = np.empty((64, metric.row_length), np.float32)

    def __len__(self) -> int:
        return self._size

    def add(self, row: NDArray[np.float32]) -> None:
        """Add a row [row_length]."""
        if self._size == len(self._held):
            self._held = np.concatenate([self._held, np.empty_like(self._held)])
        self._held[self._size] = row
        self._size += 1

    def search(
        self, row: NDArray[np.float32], count: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32] | None]:
        """Return numbers, distances and yaws [K] of the nearest rows, nearest first."""
        distance, yaw = self._metric.compare(row, self._held[: self._size])
        # Stable: equal distances come in the order in which they were seen.
        order = np.argsort(distance, kind='stable')[:count]
        return order, distance[order], None if yaw is None else yaw[order]

    def keep(self, numbers: NDArray[np.intp]) -> None:
        """Forget all other rows."""
        self._held[: len(numbers)] = self._held[numbers]
        self._size = len(numbers)


def _rows(metric: Metric) -> 'ComparedRows | CompactSearch':
    if not metric.unit_length:
        return ComparedRows(metric)
    from lcd_loop_closure.compact_search import CompactSearch  # torch takes seconds

    return CompactSearch(metric.row_length)
