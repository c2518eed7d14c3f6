"""Answer which known place a scan shows, how far that can be believed, and let the map grow."""

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_loop_closure.compact_cloud import CompactCloud, compact
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from uncertain_place_recognition.place import Judgement, Match, Place, PlaceAnswer
from uncertain_place_recognition.place_folder import SavedPlaces, load_places, save_places
from uncertain_place_recognition.retrieval.engines import IndexMaker
from uncertain_place_recognition.retrieval.fleet_place import FleetPlace
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex
from uncertain_place_recognition.uncertainty import (
    feature_variance,
    mean_descriptor,
    total_uncertainty,
)

NOTHING_CALIBRATED = 'nothing is calibrated for this ensemble: no match is accepted'


@config
class PlaceRecognizerConfig:
    """How a scan is answered, and how the map grows."""

    matches: int = setting(5, 'places of one answer', low=1)
    delay: int = setting(5, 'places that must follow a new one before it can be an answer', low=0)
    position_sigma: float = setting(
        5.0, 'how far a scan may be from the place it matches', unit='m', low=0.01
    )
    height_sigma: float = setting(1.0, 'the same, upwards', unit='m', low=0.01)
    tilt_sigma: float = setting(0.1, 'difference in roll and pitch', unit='rad', low=0.001)
    heading_sigma: float = setting(
        1.8, 'difference in heading; 1.8 is any heading at all', unit='rad', low=0.001
    )
    keep_clouds: bool = setting(
        True, 'keep a reduced cloud of each place (70 kB), for relocalization'
    )


class Ensemble(Protocol):
    """What is asked of an ensemble of embedding networks."""

    @property
    def length(self) -> int:
        """Length D of an embedding."""

    def embed(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return one embedding [M x D] of each member for a submap [N x 3]."""


class Submaps(Protocol):
    """What makes submaps of sweeps."""

    def make(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the submap [N x 3] of a sweep in the base frame."""


class Judge(Protocol):
    """What tells how far the best match can be believed."""

    @property
    def metric(self) -> str:
        """How places are to be ranked."""

    @property
    def matches(self) -> int:
        """Neighbours that a judgement needs."""

    @property
    def spacing_m(self) -> float | None:
        """How far apart places were when it learnt to judge; None when nobody knows."""

    def reset(self) -> None:
        """Forget the scans so far: another drive begins."""

    def judge(
        self,
        neighbours: Neighbours,
        positions: se3.Array,
        uncertainty: float,
        database_size: int,
    ) -> Judgement:
        """Judge the first of the neighbours, which lie at positions [K x 3] in the map."""


class PlaceRecognizer:
    """Know places, and recognise them; the map is one index, whatever the ensemble's size.

    Members of a shared-space ensemble speak one language: a place is their mean descriptor, and
    how far they disagree about a scan says how little it can be believed (thesis 4.2). Several
    threads may call it.

    With an index that a fleet shares (`QdrantIndex`) answers also name places that other vehicles
    added, by ids of their own (`elsewhere`); poses are then those that the others told, so all must
    use one map frame. What is saved, loaded, moved, counted and forgotten are this vehicle's.
    """

    def __init__(
        self,
        ensemble: Ensemble,
        submaps: Submaps,
        judge: Judge | None = None,
        settings: PlaceRecognizerConfig | None = None,
        reduction: ReductionConfig | None = None,
        index: IndexMaker | None = None,
        *,
        fingerprint: str,
    ) -> None:
        """Start without places.

        Args:
            ensemble: embeds submaps.
            submaps: as the ensemble was trained on.
            judge: says which matches to believe; None accepts none.
            settings: of answers and growth.
            reduction: of the clouds that are kept.
            index: makes what searches the places; None: all are compared.
            fingerprint: hash of the weights (`weights_hash`); maps of others are refused.

        Raises:
            LocalizationError: there can be no such index (`IndexMaker.make`).
        """
        self.ensemble, self._submaps, self._judge = ensemble, submaps, judge
        self.fingerprint = fingerprint
        self.settings = settings or PlaceRecognizerConfig()
        self._reduction = reduction or ReductionConfig()
        self._maker = index or IndexMaker()
        self._lock = threading.RLock()
        self.clear()

    def __len__(self) -> int:
        return len(self._places)

    @property
    def searchable(self) -> int:
        """Places that can be answered: those that are not too new."""
        return self._index.searchable

    @property
    def calibrated_spacing_m(self) -> float | None:
        """How far apart places must be for what is said of matches; None when nobody knows."""
        return None if self._judge is None else self._judge.spacing_m

    @property
    def next_id(self) -> int:
        """A number above all places."""
        return max(self._places, default=-1) + 1

    def clear(self) -> None:
        """Forget all places; what a shared map has taken in stays there."""
        with self._lock:
            self._index = self._empty_index()
            self._places: dict[int, Place] = {}
            self._clouds: dict[int, CompactCloud] = {}
            self._elsewhere: dict[int, FleetPlace] = {}
        self.start_drive()

    def close(self) -> None:
        """Let go of the folder or the connection of a shared map; nothing works afterwards."""
        with self._lock:
            self._index.close()

    def start_drive(self) -> None:
        """Forget what the last drive told about drift; places stay."""
        if self._judge is not None:
            self._judge.reset()

    def embed(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the members' embeddings [M x D] of a sweep in the base frame.

        Raises:
            DataError: too little is left above the ground, or the networks answer with NaN.
        """
        members = self.ensemble.embed(self._submaps.make(cloud.finite()))
        if not np.isfinite(members).all():
            raise DataError('expected finite embeddings, the ensemble answered with NaN')
        return members

    def locate(
        self,
        scan: PointCloud | NDArray[np.float32],
        stamp_ns: int | None = None,
        near: NDArray[np.float64] | None = None,
    ) -> PlaceAnswer:
        """Return the known places most like a scan.

        Args:
            scan: sweep in the base frame, or its embeddings (`embed`).
            stamp_ns: of the scan.
            near: [2 or 3] where it was taken, as far as is known, metres in the map; an index that
                divides the map by place may search only there.

        Raises:
            DataError: the scan cannot be embedded.
            MapError: a shared map does not answer.
        """
        members = self._members(scan)
        raw = float(total_uncertainty(members, normalised=False))
        normalised = float(total_uncertainty(members, normalised=True))
        wanted = max(self.settings.matches, 0 if self._judge is None else self._judge.matches)
        with self._lock:
            found = self._index.search(mean_descriptor(members), wanted, stamp_ns, near)
            self._elsewhere.update(found.elsewhere)
            places = [self.place(int(id)) for id in found.place_id]
            size = self._index.searchable if found.searched is None else found.searched
        judgement = self._judged(found, places, normalised, size)
        return PlaceAnswer(
            tuple(
                self._match(place, found, rank, judgement if rank == 0 else None)
                for rank, place in enumerate(places[: self.settings.matches])
            ),
            uncertainty=raw,
            uncertainty_normalised=normalised,
            variances=feature_variance(members),
            database_size=size,
            withdrawn=judgement.withdrawn,
        )

    def add(
        self,
        scan: PointCloud | NDArray[np.float32],
        T_map_base: se3.Array,
        *,
        stamp_ns: int,
        id: int | None = None,
        covariance: se3.Array | None = None,
        cloud: PointCloud | None = None,
    ) -> int:
        """Remember a place; it can be an answer once `settings.delay` others followed.

        Args:
            scan: sweep in the base frame, or its embeddings.
            T_map_base: where it was taken, metres.
            stamp_ns: when.
            id: its number; None: the next.
            covariance: 6x6 of T_map_base, body axes, translation first.
            cloud: the sweep, to be kept for relocalization when `scan` is its embeddings.

        Returns:
            The number of the place.

        Raises:
            DataError: the scan cannot be embedded, or the number is taken.
            MapError: a shared map does not answer; the place is kept, and told when it does.
        """
        members = self._members(scan)
        kept = scan if isinstance(scan, PointCloud) else cloud
        with self._lock:
            id = self.next_id if id is None else int(id)
            if id in self._places:
                raise DataError(f'place {id} is known already; choose another number')
            self._places[id] = Place(id, stamp_ns, T_map_base, covariance)
            if kept is not None and self.settings.keep_clouds:
                self._clouds[id] = compact(reduce_cloud(kept, self._reduction))
            try:
                self._index.note_poses([self._places[id]])
                self._index.add(id, mean_descriptor(members), stamp_ns)
            except DataError:
                del self._places[id]
                self._clouds.pop(id, None)
                raise
        return id

    def place(self, id: int) -> Place:
        """Return a place, also one of another vehicle that was an answer; DataError if unknown."""
        known = self._places.get(id)
        return self.elsewhere(id).place if known is None else known

    def elsewhere(self, id: int) -> FleetPlace:
        """Return who added a place that was an answer and is not in this vehicle's map.

        Raises:
            DataError: there was none of that id.
        """
        try:
            return self._elsewhere[id]
        except KeyError:
            raise DataError(f'place {id} is not in the map') from None

    def places(self) -> list[Place]:
        """Return all places in the order in which they came."""
        with self._lock:
            return list(self._places.values())

    def cloud(self, id: int) -> PointCloud | None:
        """Return the reduced cloud of a place (base frame); None when it was not kept."""
        kept = self._clouds.get(id)
        return None if kept is None else kept.cloud()

    def move(self, T_map_base: Mapping[int, se3.Array]) -> None:
        """Correct the poses of places by their ids; unknown ones are left out.

        Raises:
            MapError: a shared map does not answer; it is told when it does.
        """
        with self._lock:
            known = [(self._places[id], T) for id, T in T_map_base.items() if id in self._places]
            moved = [Place(p.id, p.stamp_ns, T, p.covariance) for p, T in known]
            self._places |= {place.id: place for place in moved}
            self._index.note_poses(moved)

    def save(self, path: str | Path) -> Path:
        """Write all places into a folder, the new ones too; return it.

        Raises:
            MapError: the folder holds something else, or the disk does not take it.
        """
        with self._lock:
            saved = SavedPlaces(self.fingerprint, tuple(self._places.values()), dict(self._clouds))
            return save_places(saved, self._index, path)

    def load(self, path: str | Path) -> int:
        """Replace all places by saved ones, all of which can be answers; return their number.

        Raises:
            MapError: there is no readable folder, or it is another ensemble's; then all stays.
        """
        index = self._empty_index()
        saved = load_places(path, self.fingerprint, index)
        with self._lock:
            self._places = {place.id: place for place in saved.places}
            self._clouds = dict(saved.clouds)
            self._elsewhere = {}
            self._index = index
        self.start_drive()
        return len(saved.places)

    def _empty_index(self) -> WindowedIndex:
        metric = 'cosine' if self._judge is None else self._judge.metric
        window = InsertionConfig(entries=self.settings.delay)
        return self._maker.make(self.ensemble.length, metric, window, self.fingerprint)

    def _members(self, scan: PointCloud | NDArray[np.float32]) -> NDArray[np.float32]:
        return self.embed(scan) if isinstance(scan, PointCloud) else scan

    def _judged(
        self, found: Neighbours, places: list[Place], uncertainty: float, size: int
    ) -> Judgement:
        if self._judge is None:
            return Judgement(None, False, NOTHING_CALIBRATED)
        positions = np.reshape([place.T_map_base[:3, 3] for place in places], (-1, 3))
        return self._judge.judge(found, positions, uncertainty, size)

    def _match(
        self, place: Place, found: Neighbours, rank: int, judgement: Judgement | None
    ) -> Match:
        covariance = self._resolution()
        if place.covariance is not None:
            covariance = covariance + place.covariance
        return Match(
            place_id=place.id,
            T_map_base=place.T_map_base,
            covariance=covariance,
            similarity=float(found.similarity[rank]),
            distance=float(found.distance[rank]),
            false_match_probability=(
                None if judgement is None else judgement.false_match_probability
            ),
            accepted=judgement is not None and judgement.accepted,
        )

    def _resolution(self) -> se3.Array:
        s = self.settings
        sigmas = [s.position_sigma, s.position_sigma, s.height_sigma]
        sigmas += [s.tilt_sigma, s.tilt_sigma, s.heading_sigma]
        return np.diag(np.square(sigmas))
