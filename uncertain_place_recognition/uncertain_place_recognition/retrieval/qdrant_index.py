"""Keep the descriptors of many vehicles in one Qdrant server or cluster, divided by place."""

import itertools
import logging
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import ConfigError, DataError, MapError
from lcd_common.settings import config, setting
from uncertain_place_recognition.missing_package import optional_package
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.retrieval.descriptor_rows import (
    DescriptorRows,
    checked_descriptor,
    directions,
)
from uncertain_place_recognition.retrieval.fleet_place import (
    FleetPlace,
    fleet_place,
    place_key,
    pose_payload,
    tiles_around,
)
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex

REQUIREMENT = 'qdrant-client==1.20.0'
_RERANKED = 4
_log = logging.getLogger(__name__)
_BATCH = 256
_NOWHERE = {'T_map_base': None, 'covariance': None, 'cell': ''}


@config
class QdrantConfig:
    """Engine qdrant: where the shared map is (a server, a folder, or both empty: memory)."""

    url: str = setting('', 'server, e.g. http://maps.local:6333; empty: in this process')
    folder: str = setting('', 'in this process: where it is kept; empty: in memory, until a reset')
    collection: str = setting('places', 'name of the collection')
    vehicle: str = setting('', 'name of this vehicle, another than those of all others')
    tile: float = setting(
        250.0, 'side of the squares that divide the map, of all vehicles alike', unit='m', low=1.0
    )
    radius: float = setting(
        0.0,
        'search only squares this near to where the vehicle believes to be; more than it may be '
        'wrong; 0: all',
        unit='m',
        low=0.0,
    )
    api_key: str = setting('', 'of the server; a parameter that all of ROS can read; empty: none')
    timeout: int = setting(5, 'until a request to the server fails', unit='s', low=1)
    shards: int = setting(1, 'parts of a new collection on a cluster', low=1)
    replicas: int = setting(1, 'copies of each part on a cluster', low=1)


class QdrantIndex(WindowedIndex):
    """A map that a fleet shares: every vehicle adds to the collection and searches all of it.

    An entry carries its descriptor and, once `note_poses` told it, all that another vehicle needs
    to answer with it: who added it, its number there, stamp, pose and covariance. **All vehicles
    must use one map frame**; nothing here can tell whether they do. A search sees only entries of
    the same ensemble. Its own places it answers by their numbers, others by `elsewhere_id`.

    The map is divided into square tiles. With a radius and a position to look `near`, the server,
    which keeps what belongs to a tile together (a tenant index), searches the tiles around it
    alone, so that the places which may be taken for one another do not grow in number with the
    fleet, and neither does the rate of false matches.

    The first look is Qdrant's own, by its graph; the best come back and are ranked exactly. What a
    server did not take is sent again with the next request; written twice it is one entry.

    Limits: without a server the client compares everything, in Python and in one process: for tests
    and small maps. Shards and replicas are settings of the server's cluster; they are handed on and
    were not tried on one. Nothing is ever deleted: a place that was added stays, whatever its
    vehicle forgets. An entry without a pose is found by the index that added it alone. A server
    that does not answer raises MapError, and whoever calls decides how to go on.
    """

    def __init__(
        self,
        length: int,
        metric: str = 'cosine',
        window: InsertionConfig | None = None,
        settings: QdrantConfig | None = None,
        *,
        ensemble: str = '',
        client: Any = None,
    ) -> None:
        """Open the collection, or make it.

        Args:
            length: of a descriptor.
            metric: as every index has it.
            window: as every index has it.
            settings: of the collection.
            ensemble: hash of the weights; entries of others are not seen.
            client: an open connection (`open_client`); None: one of its own.

        Raises:
            MissingPackageError: the client is not installed.
            ConfigError: the settings contradict one another.
            MapError: the server does not answer, or the collection is of another kind.
        """
        super().__init__(length, metric, window)
        self.settings, self.ensemble = settings or QdrantConfig(), ensemble
        self._package = _package()
        self._client = open_client(self.settings) if client is None else client
        self._places: dict[int, Place] = {}
        self._own: dict[str, int] = {}  # keys of what this index added
        self._unsent: dict[str, tuple[int, NDArray[np.float32]]] = {}
        self._moved: dict[str, Place] = {}
        self._damaged: set[str] = set()
        self._tiles: list[str] = []  # of the search that goes on; empty: all
        with self._asking():
            self._open()

    @property
    def searchable(self) -> int:
        """Entries of the collection, of this ensemble but of all vehicles and tiles."""
        return self._count(())

    def close(self) -> None:
        """Let go of the connection, or of the folder."""
        self._client.close()

    def note_poses(self, places: Iterable[Place]) -> None:
        """Note where places are; of those that are in the collection, correct it.

        Raises:
            MapError: the server does not answer; the next request tells it.
        """
        told = {self._key(place): place for place in places}
        self._places |= {place.id: place for place in told.values()}
        moved = {key: place for key, place in told.items() if key in self._own}
        if moved:
            self._moved |= moved
            self._send()

    def search(
        self,
        descriptor: NDArray[np.floating],
        k: int,
        stamp_ns: int | None = None,
        near: NDArray[np.float64] | None = None,
    ) -> Neighbours:
        """Return up to k places, best first; with a radius, of the tiles `near` a position alone.

        Raises:
            DataError: the descriptor has another length or is not finite.
            MapError: the server does not answer.
        """
        s = self.settings
        row = checked_descriptor(descriptor, self.length)
        self._insert_entries(self._window.release(stamp_ns))
        self._send()
        tiles: list[str] = []
        if near is not None and s.radius:
            tiles = tiles_around(float(near[0]), float(near[1]), s.radius, s.tile)
        self._tiles = tiles
        return replace(self._nearest(row, k), searched=self._count(tiles))

    def _insert(self, place_id: NDArray[np.int64], rows: NDArray[np.float32]) -> None:
        for number, row in zip(place_id.tolist(), rows, strict=True):
            place = self._places.get(number)
            key = str(uuid.uuid4()) if place is None else self._key(place)
            self._unsent[key] = number, row
        self._send()

    def _nearest(self, query: NDArray[np.float32], k: int) -> Neighbours:
        with self._asking():
            points = self._client.query_points(
                self.settings.collection,
                query=query.tolist(),
                limit=_RERANKED * max(k, 1),
                query_filter=self._among(self._tiles),
                with_vectors=True,
            ).points
        elsewhere = {key: found for key, found in map(self._read_elsewhere, points) if found}
        points = [p for p in points if str(p.id) in self._own or str(p.id) in elsewhere]
        keys = [str(point.id) for point in points]
        ids = [elsewhere[k].place.id if k in elsewhere else self._own[k] for k in keys]
        rows = DescriptorRows(self.length, len(points))
        rows.append(np.array(ids, np.int64), self._rows(points))
        best = rows.ranked(query, np.arange(len(rows)), max(k, 0), self.metric)
        kept = set(best.place_id.tolist())
        by_id = {found.place.id: found for found in elsewhere.values()}
        return replace(best, elsewhere={id: by_id[id] for id in by_id.keys() & kept})

    def _read_elsewhere(self, point: Any) -> tuple[str, FleetPlace | None]:
        key = str(point.id)
        if key in self._own:
            return key, None
        try:
            return key, fleet_place(key, point.payload)
        except DataError as error:
            # What one vehicle damaged must not cost all others their answers.
            if key not in self._damaged:
                _log.warning('left out: %s', error)
            self._damaged.add(key)
            return key, None

    def _entries(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        # What others added is theirs to save.
        self._send()
        points: list[Any] = []
        keys = iter(self._own)
        with self._asking():
            while part := list(itertools.islice(keys, _BATCH)):
                points += self._client.retrieve(
                    self.settings.collection, part, with_payload=True, with_vectors=True
                )
        if len(points) < len(self._own):
            raise MapError(
                f'{len(self._own) - len(points)} of {len(self._own)} places of this vehicle are '
                f'gone from the collection {self.settings.collection}; who deletes there?'
            )
        ids = np.array([self._own[str(point.id)] for point in points], np.int64)
        return ids, self._rows(points)

    def _rows(self, points: list[Any]) -> NDArray[np.float32]:
        lengths = np.array([point.payload['length'] for point in points], np.float32)
        vectors = np.array([point.vector for point in points], np.float32)
        return vectors.reshape(-1, self.length) * lengths[:, None]

    def _send(self) -> None:
        """Write what the collection does not have yet."""
        collection, models = self.settings.collection, self._package.models
        while self._unsent:
            part = dict(itertools.islice(self._unsent.items(), _BATCH))
            points = [self._point(key, *entry) for key, entry in part.items()]
            with self._asking():
                self._client.upsert(collection, points, wait=True)
            for key, (number, _) in part.items():
                self._own[key] = number
                del self._unsent[key]
        while self._moved:
            moved = dict(itertools.islice(self._moved.items(), _BATCH))
            payloads = [
                models.SetPayload(payload=pose_payload(place, self.settings.tile), points=[key])
                for key, place in moved.items()
            ]
            with self._asking():
                self._client.batch_update_points(
                    collection, [models.SetPayloadOperation(set_payload=p) for p in payloads]
                )
            for key in moved:
                del self._moved[key]

    def _point(self, key: str, number: int, row: NDArray[np.float32]) -> Any:
        # Qdrant keeps directions alone where it compares by cosine: lengths go beside.
        by_cosine = self.metric == 'cosine'
        place = self._places.get(number)
        payload = {
            'ensemble': self.ensemble,
            'vehicle': self.settings.vehicle,
            'place_id': number,
            'stamp_ns': None if place is None else place.stamp_ns,
            'length': float(np.linalg.norm(row)) if by_cosine else 1.0,
            'tile': self.settings.tile,
            **(_NOWHERE if place is None else pose_payload(place, self.settings.tile)),
        }
        vector = directions(row[None])[0] if by_cosine else row
        return self._package.models.PointStruct(id=key, vector=vector.tolist(), payload=payload)

    def _key(self, place: Place) -> str:
        return str(place_key(self.ensemble, self.settings.vehicle, place.id, place.stamp_ns))

    def _among(self, tiles: Sequence[str]) -> Any:
        models = self._package.models
        same = models.FieldCondition(key='ensemble', match=models.MatchValue(value=self.ensemble))
        if not tiles:
            return models.Filter(must=[same])
        any_of = models.FieldCondition(key='cell', match=models.MatchAny(any=list(tiles)))
        return models.Filter(must=[same, any_of])

    def _count(self, tiles: Sequence[str]) -> int:
        with self._asking():
            among = self._among(tiles)
            counted = self._client.count(self.settings.collection, count_filter=among, exact=True)
            return int(counted.count)

    def _open(self) -> None:
        s, models, client = self.settings, self._package.models, self._client
        by = models.Distance.COSINE if self.metric == 'cosine' else models.Distance.EUCLID
        if not client.collection_exists(s.collection):
            self._make_collection(by)
        found = client.get_collection(s.collection).config.params.vectors
        if (found.size, found.distance) != (self.length, by):
            raise MapError(
                f'the collection {s.collection} holds descriptors of {found.size} numbers, ranked '
                f'by {found.distance.value}; expected {self.length} numbers, {by.value}: name '
                'another collection'
            )
        # A search that looks for squares of another size would miss places in silence.
        first, _ = client.scroll(s.collection, limit=1, with_payload=['tile'])
        tile = first[0].payload.get('tile', s.tile) if first else s.tile
        if tile != s.tile:
            raise MapError(
                f'the collection {s.collection} has tiles of {tile:g} m, these settings {s.tile:g} '
                'm: use one size in the whole fleet'
            )

    def _make_collection(self, by: Any) -> None:
        s, models, client = self.settings, self._package.models, self._client
        try:
            client.create_collection(
                s.collection,
                vectors_config=models.VectorParams(size=self.length, distance=by),
                shard_number=s.shards,
                replication_factor=s.replicas,
            )
        except self._package.http.exceptions.ApiException:
            if not client.collection_exists(s.collection):
                raise
            return  # another vehicle was faster
        if s.url:  # the client's own search has no payload indices and says so
            tenant = models.KeywordIndexParams(type='keyword', is_tenant=True)
            client.create_payload_index(s.collection, 'cell', tenant)
            client.create_payload_index(s.collection, 'ensemble', 'keyword')

    @contextmanager
    def _asking(self) -> Iterator[None]:
        with _asking(self._package, self.settings):
            yield


def open_client(settings: QdrantConfig) -> Any:
    """Return a connection to the server, or to what is kept in this process.

    Raises:
        MissingPackageError: the client is not installed.
        ConfigError: the settings contradict one another.
        MapError: the folder is in use.
    """
    s = settings
    if s.url and s.folder:
        raise ConfigError('name a server (url) or a folder, not both')
    if (s.url or s.folder) and not s.vehicle:
        raise ConfigError(
            'expected the name of this vehicle (vehicle), got none: entries of a shared map say '
            'who added them; give every vehicle another'
        )
    package = _package()
    with _asking(package, s):
        if s.url:
            return package.QdrantClient(
                url=s.url, api_key=s.api_key or None, timeout=s.timeout, check_compatibility=False
            )
        # The one who calls lets one thread in at a time, but not always the same.
        place = {'path': s.folder} if s.folder else {'location': ':memory:'}
        return package.QdrantClient(**place, force_disable_check_same_thread=True)


def _package() -> Any:
    return optional_package('qdrant_client', REQUIREMENT, 'QdrantIndex')


@contextmanager
def _asking(package: Any, settings: QdrantConfig) -> Iterator[None]:
    try:
        yield
    except (package.http.exceptions.ApiException, RuntimeError, OSError) as error:
        where = settings.url or settings.folder or 'memory'
        raise MapError(
            f'Qdrant at {where} does not answer: {_first_line(error)}; is it running, and is '
            'the folder in use by no other process?'
        ) from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
