"""Search all descriptors: exact, without training or rebuilding, and enough up to a million."""

import numpy as np
from numpy.typing import NDArray

from lcd_loop_closure.compact_search import CompactSearch
from uncertain_place_recognition.retrieval.descriptor_rows import DescriptorRows, directions
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex


class ExactIndex(WindowedIndex):
    """One array in single precision that doubles when full; the default."""

    def __init__(
        self, length: int, metric: str = 'cosine', window: InsertionConfig | None = None
    ) -> None:
        super().__init__(length, metric, window)
        self._rows = DescriptorRows(length)

    @property
    def searchable(self) -> int:
        """Entries that can be found."""
        return len(self._rows)

    def _insert(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        self._rows.append(place_id, rows)

    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        return self._rows.nearest(query, k, self.metric)

    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        return self._rows.place_id, self._rows.rows


class CompactIndex(WindowedIndex):
    """The same answers by cosine in less time: a first look with eight bits a number.

    What takes time is reading the rows, and eight bits are a quarter of it; all that rounding
    leaves in question is compared again in single precision (`compact_search`). By cosine alone:
    the Euclidean order of descriptors of unequal length needs their lengths.
    """

    def __init__(self, length: int, window: InsertionConfig | None = None) -> None:
        super().__init__(length, 'cosine', window)
        self._search = CompactSearch(length)
        self._rows = DescriptorRows(length)

    @property
    def searchable(self) -> int:
        """Entries that can be found."""
        return len(self._rows)

    def _insert(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        self._rows.append(place_id, rows)
        self._search.add(directions(rows))

    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        found, _ = self._search.nearest(directions(query[None])[0], k)
        return self._rows.ranked(query, np.sort(found), k, self.metric)

    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        return self._rows.place_id, self._rows.rows
