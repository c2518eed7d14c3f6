"""Search beyond a million descriptors with faiss, whose graphs and lists look at a part only."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.settings import config, setting
from uncertain_place_recognition.missing_package import optional_package
from uncertain_place_recognition.retrieval.descriptor_rows import DescriptorRows, directions
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex

REQUIREMENT = 'faiss-cpu==1.15.1'
_RERANKED = 4
_PER_LIST = 40  # faiss warns below 39 training rows a list


@config
class FaissConfig:
    """How much faiss looks at: more finds more of the true neighbours, and takes longer."""

    kind: str = setting('hnsw', 'graph (hnsw) or inverted lists (ivf)', choices=('hnsw', 'ivf'))
    exact_below: int = setting(20_000, 'entries up to which all are compared', low=0)
    links: int = setting(16, 'HNSW: links of an entry', low=4)
    build_breadth: int = setting(100, 'HNSW: candidates while building', low=8)
    search_breadth: int = setting(64, 'HNSW: candidates while searching', low=8)
    probes: int = setting(16, 'IVF: lists that are searched', low=1)


class FaissIndex(WindowedIndex):
    """Approximate search in half precision, then exact ranking of the best.

    Up to `exact_below` entries it compares all, as `ExactIndex` does. Memory a descriptor of D
    numbers: 4 D bytes for the exact ranking, 2 D for the first look, and about 8 x links for HNSW.

    Limits: a neighbour that the first look misses stays missed, and that is part of the false-match
    statistics: calibrate with the index that is deployed. IVF learns its lists from the entries
    there are when it first needs them; a map that grows into other places afterwards should be
    loaded afresh. Nothing can be removed. One process: use `QdrantIndex` to share a map.
    """

    def __init__(
        self,
        length: int,
        metric: str = 'cosine',
        window: InsertionConfig | None = None,
        settings: FaissConfig | None = None,
    ) -> None:
        """Find the package.

        Raises:
            MissingPackageError: it is not installed.
        """
        super().__init__(length, metric, window)
        self.settings = settings or FaissConfig()
        self._faiss = optional_package('faiss', REQUIREMENT, 'FaissIndex')
        self._rows = DescriptorRows(length)
        self._graph: Any = None

    @property
    def searchable(self) -> int:
        """Entries that can be found."""
        return len(self._rows)

    def _insert(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        self._rows.append(place_id, rows)
        if self._graph is not None:
            self._graph.add(self._compared(rows))
        elif len(self._rows) > self.settings.exact_below:
            self._graph = self._built()

    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        if self._graph is None:
            return self._rows.nearest(query, k, self.metric)
        _, found = self._graph.search(self._compared(query[None]), min(_RERANKED * k, len(self)))
        return self._rows.ranked(query, np.sort(found[0][found[0] >= 0]), k, self.metric)

    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        return self._rows.place_id, self._rows.rows

    def _built(self) -> Any:
        s, faiss = self.settings, self._faiss
        rows = self._compared(self._rows.rows)
        # By cosine, too: of unit vectors both orders are the same, and graphs want a distance.
        half = faiss.ScalarQuantizer.QT_fp16
        if s.kind == 'hnsw':
            graph = faiss.IndexHNSWSQ(self.length, half, s.links, faiss.METRIC_L2)
            graph.hnsw.efConstruction = s.build_breadth
            graph.hnsw.efSearch = s.search_breadth
        else:
            lists = max(1, min(len(rows) // _PER_LIST, round(4.0 * np.sqrt(len(rows)))))
            coarse = faiss.IndexFlatL2(self.length)
            graph = faiss.IndexIVFScalarQuantizer(
                coarse, self.length, lists, half, faiss.METRIC_L2, False
            )
            graph.nprobe = min(s.probes, lists)
        graph.train(rows)
        graph.add(rows)
        return graph

    def _compared(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.metric == 'cosine':
            return directions(rows)
        return np.ascontiguousarray(rows, np.float32)
