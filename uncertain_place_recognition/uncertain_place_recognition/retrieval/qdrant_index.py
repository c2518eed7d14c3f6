"""Keep the descriptors of many vehicles in one Qdrant server or cluster, divided by place."""

import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import ConfigError, MapError
from lcd_common.settings import config, setting
from uncertain_place_recognition.missing_package import optional_package
from uncertain_place_recognition.retrieval.descriptor_rows import (
    DescriptorRows,
    checked_descriptor,
    directions,
)
from uncertain_place_recognition.retrieval.insertion_window import Entry, InsertionConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex

REQUIREMENT = 'qdrant-client==1.20.0'
_RERANKED = 4
_BATCH = 256


@config
class QdrantConfig:
    """Where the collection is: a server's address, a folder, or (both empty) memory."""

    url: str = setting('', 'server, e.g. http://maps.local:6333; empty: in this process')
    folder: str = setting('', 'in this process: where it is kept; empty: in memory')
    collection: str = setting('places', 'name of the collection')
    api_key: str = setting('', 'of the server; empty: none')
    timeout: int = setting(5, 'until a request to the server fails', unit='s', low=1)
    shards: int = setting(1, 'parts of a new collection on a cluster', low=1)
    replicas: int = setting(1, 'copies of each part on a cluster', low=1)


class QdrantIndex(WindowedIndex):
    """A map that a fleet shares: every vehicle adds to the collection and searches all of it.

    An entry carries the cell of the map to which it belongs (a geohash, a tile, a town). With a
    prior position, name the cells near it: the server keeps what belongs to a cell together (a
    tenant index) and searches that alone, so that the places which may be taken for one another do
    not grow in number with the fleet, and neither does the rate of false matches.

    The first look is Qdrant's own, by its graph; the best come back and are ranked exactly. Entries
    get random keys of their own, so that vehicles need not agree about ids of places.

    Limits: without a server the client compares everything, in Python and in one process: for tests
    and small maps. Shards and replicas are settings of the server's cluster; they are handed on and
    were not tried on one. A file that `save` writes has no cells. A server that does not answer
    raises MapError, and whoever calls decides how to go on; entries of a call that failed half way
    may be there twice after it is repeated.
    """

    def __init__(
        self,
        length: int,
        metric: str = 'cosine',
        window: InsertionConfig | None = None,
        settings: QdrantConfig | None = None,
    ) -> None:
        """Open the collection, or make it.

        Raises:
            MissingPackageError: the client is not installed.
            MapError: the server does not answer, or the collection is of another kind.
        """
        super().__init__(length, metric, window)
        self.settings = s = settings or QdrantConfig()
        if s.url and s.folder:
            raise ConfigError('name a server (url) or a folder, not both')
        self._package = optional_package('qdrant_client', REQUIREMENT, 'QdrantIndex')
        self._cells: tuple[str, ...] = ()
        with self._asking():
            if s.url:
                self._client = self._package.QdrantClient(
                    url=s.url,
                    api_key=s.api_key or None,
                    timeout=s.timeout,
                    check_compatibility=False,
                )
            elif s.folder:
                self._client = self._package.QdrantClient(path=s.folder)
            else:
                self._client = self._package.QdrantClient(':memory:')
            self._open()

    @property
    def searchable(self) -> int:
        """Entries of the collection, of all vehicles and cells."""
        with self._asking():
            return int(self._client.count(self.settings.collection, exact=True).count)

    def close(self) -> None:
        """Let go of the connection, or of the folder."""
        self._client.close()

    def add(
        self,
        place_id: int,
        descriptor: NDArray[np.floating],
        stamp_ns: int | None = None,
        cell: str = '',
    ) -> None:
        """Take in a descriptor [length] of a cell; with a stamp it waits until the delay is over.

        Raises:
            DataError: it has another length or is not finite.
            MapError: the server does not answer.
        """
        row = checked_descriptor(descriptor, self.length)
        self._insert_entries(self._window.push(Entry(int(place_id), row, stamp_ns, cell)))

    def search(
        self,
        descriptor: NDArray[np.floating],
        k: int,
        stamp_ns: int | None = None,
        cells: Sequence[str] = (),
    ) -> Neighbours:
        """Return up to k places of some cells, best first; of all cells where none is named."""
        self._cells = tuple(cells)
        return super().search(descriptor, k, stamp_ns)

    def _insert_entries(self, entries: Sequence[Entry]) -> None:
        for cell in dict.fromkeys(entry.cell for entry in entries):
            of_cell = [entry for entry in entries if entry.cell == cell]
            rows = np.stack([entry.descriptor for entry in of_cell])
            self._insert(np.array([entry.place_id for entry in of_cell], np.int64), rows, cell)

    def _insert(
        self, place_id: NDArray[np.int64], rows: NDArray[np.float32], cell: str = ''
    ) -> None:
        # Qdrant keeps directions alone where it compares by cosine: lengths go beside.
        by_cosine = self.metric == 'cosine'
        lengths = np.linalg.norm(rows, axis=1) if by_cosine else np.ones(len(rows))
        vectors = directions(rows) if by_cosine else rows
        points = [
            self._package.models.PointStruct(
                id=str(uuid.uuid4()),
                vector=vector.tolist(),
                payload={'place_id': int(number), 'length': float(length), 'cell': cell},
            )
            for number, vector, length in zip(place_id, vectors, lengths, strict=True)
        ]
        with self._asking():
            for first in range(0, len(points), _BATCH):
                part = points[first : first + _BATCH]
                self._client.upsert(self.settings.collection, part, wait=True)

    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        models, of_cells = self._package.models, None
        if self._cells:
            any_of = models.MatchAny(any=list(self._cells))
            of_cells = models.Filter(must=[models.FieldCondition(key='cell', match=any_of)])
        with self._asking():
            points = self._client.query_points(
                self.settings.collection,
                query=query.tolist(),
                limit=_RERANKED * k,
                query_filter=of_cells,
                with_vectors=True,
            ).points
        rows = DescriptorRows(self.length, len(points))
        rows.append(*self._arrays(points))
        return rows.ranked(query, np.arange(len(rows)), k, self.metric)

    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        points: list[Any] = []
        offset = None
        with self._asking():
            while True:
                part, offset = self._client.scroll(
                    self.settings.collection, limit=_BATCH, offset=offset, with_vectors=True
                )
                points += part
                if offset is None:
                    return self._arrays(points)

    def _arrays(self, points: list[Any]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        ids = np.array([point.payload['place_id'] for point in points], np.int64)
        lengths = np.array([point.payload['length'] for point in points], np.float32)
        vectors = np.array([point.vector for point in points], np.float32)
        return ids, vectors.reshape(-1, self.length) * lengths[:, None]

    def _open(self) -> None:
        s, models, client = self.settings, self._package.models, self._client
        by = models.Distance.COSINE if self.metric == 'cosine' else models.Distance.EUCLID
        if not client.collection_exists(s.collection):
            client.create_collection(
                s.collection,
                vectors_config=models.VectorParams(size=self.length, distance=by),
                shard_number=s.shards,
                replication_factor=s.replicas,
            )
            if s.url:  # the client's own search has no payload indices and says so
                keyword = models.KeywordIndexParams(type='keyword', is_tenant=True)
                client.create_payload_index(s.collection, 'cell', keyword)
        found = client.get_collection(s.collection).config.params.vectors
        if (found.size, found.distance) != (self.length, by):
            raise MapError(
                f'the collection {s.collection} holds descriptors of {found.size} numbers, ranked '
                f'by {found.distance.value}; expected {self.length} numbers, {by.value}: name '
                'another collection'
            )

    @contextmanager
    def _asking(self) -> Iterator[None]:
        failures = self._package.http.exceptions
        try:
            yield
        except (failures.ApiException, RuntimeError, OSError) as error:
            where = self.settings.url or self.settings.folder or 'memory'
            raise MapError(
                f'Qdrant at {where} does not answer: {_first_line(error)}; is it running, and is '
                'the folder in use by no other process?'
            ) from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
