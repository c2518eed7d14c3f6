"""Hold descriptors in one growing array and compare them exactly."""

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import ConfigError, DataError
from uncertain_place_recognition.retrieval.place_index import METRICS, Neighbours

_FIRST_CAPACITY = 1024


def checked_metric(metric: str) -> str:
    """Return the metric; raises ConfigError on an unknown one."""
    if metric not in METRICS:
        raise ConfigError(f'metric must be one of {", ".join(METRICS)}, got {metric!r}')
    return metric


def checked_descriptor(descriptor: NDArray[np.floating], length: int) -> NDArray[np.float32]:
    """Return a descriptor [length] float32; raises DataError when it is none."""
    row = np.asarray(descriptor, np.float32).ravel()
    if row.size != length:
        raise DataError(
            f'expected a descriptor of {length} numbers, got {row.size}; was the map made with '
            'another ensemble?'
        )
    if not np.isfinite(row).all():
        raise DataError('expected finite numbers in a descriptor, got NaN or infinity')
    return row


class DescriptorRows:
    """Rows that double their room when they need more: adding costs constant time on average."""

    def __init__(self, length: int, capacity: int = _FIRST_CAPACITY) -> None:
        self.length = length
        self._rows = np.empty((max(capacity, 1), length), np.float32)
        # Of each row: half its squared length, and one over its length.
        self._half = np.empty(len(self._rows), np.float32)
        self._inverse = np.empty(len(self._rows), np.float32)
        self._ids = np.empty(len(self._rows), np.int64)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def rows(self) -> NDArray[np.float32]:
        """Descriptors [N x length]; a view."""
        return self._rows[: self._size]

    @property
    def place_id(self) -> NDArray[np.int64]:
        """Ids [N]; a view."""
        return self._ids[: self._size]

    def append(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        """Add rows [K x length] with their ids [K]."""
        first, last = self._size, self._size + len(rows)
        more = max(len(self._rows), last - len(self._rows)) if last > len(self._rows) else 0
        if more:
            self._rows = np.concatenate([self._rows, np.empty((more, self.length), np.float32)])
            self._half, self._inverse, self._ids = (
                np.concatenate([array, np.empty(more, array.dtype)])
                for array in (self._half, self._inverse, self._ids)
            )
        squared = np.einsum('ij,ij->i', rows, rows)
        self._rows[first:last], self._ids[first:last] = rows, place_id
        self._half[first:last] = 0.5 * squared
        self._inverse[first:last] = inverse_length(squared)
        self._size = last

    def nearest(self, query: NDArray[np.float32], k: int, metric: str) -> Neighbours:
        """Return the k best of all rows; equal ones in the order in which they came."""
        k = min(k, self._size)
        if k < 1:
            return self.ranked(query, np.empty(0, np.intp), k, metric)
        # Larger is better for both: what does not change the order is left out.
        score = self.rows @ query
        if metric == 'cosine':
            score *= self._inverse[: self._size]
            off = 2e-6 * float(np.linalg.norm(query))
        else:
            score -= self._half[: self._size]
            off = 0.0
        limit = np.partition(score, self._size - k)[self._size - k]
        if metric == 'euclidean':
            off = 4e-6 * (abs(float(limit)) + float(query @ query))
        # All that rounding may have moved are compared again.
        return self.ranked(query, np.flatnonzero(score >= limit - np.float32(off)), k, metric)

    def ranked(
        self, query: NDArray[np.float32], among: NDArray[np.integer], k: int, metric: str
    ) -> Neighbours:
        """Return the k best of the rows numbered `among` (ascending), compared in full."""
        rows = self._rows[among].astype(np.float64)
        whole = query.astype(np.float64)
        apart = np.linalg.norm(rows - whole, axis=1)
        own = float(inverse_length(np.array([whole @ whole]))[0])
        cosine = (rows @ whole) * inverse_length(np.einsum('ij,ij->i', rows, rows)) * own
        order = np.argsort(apart if metric == 'euclidean' else -cosine, kind='stable')[:k]
        return Neighbours(
            self._ids[among][order],
            np.clip(cosine[order], -1.0, 1.0).astype(np.float32),
            apart[order].astype(np.float32),
        )


def inverse_length(squared: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return one over the square root; 0 of 0, so that a zero descriptor is like nothing."""
    return np.divide(1.0, np.sqrt(squared), out=np.zeros_like(squared), where=squared > 0.0)


def directions(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return rows [N x length] scaled to unit length; one of zeros gets any direction."""
    units = rows * inverse_length(np.einsum('ij,ij->i', rows, rows))[:, None]
    units[~units.any(axis=1), 0] = 1.0
    return np.ascontiguousarray(units, np.float32)
