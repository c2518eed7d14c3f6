"""Say what every index of places can do, whichever engine answers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uncertain_place_recognition.retrieval.fleet_place import FleetPlace

METRICS = ('cosine', 'euclidean')


@dataclass(frozen=True)
class Neighbours:
    """Places most like a query, best first.

    Attributes:
        place_id: [K] int64.
        similarity: [K] cosine of descriptors (equation 22), -1 .. 1.
        distance: [K] Euclidean distance of descriptors.
        elsewhere: those of them that are not in this vehicle's map, by their place_id.
        searched: entries that were looked through, where the engine says so.
    """

    place_id: NDArray[np.int64]
    similarity: NDArray[np.float32]
    distance: NDArray[np.float32]
    elsewhere: Mapping[int, FleetPlace] = field(default_factory=dict)
    searched: int | None = None

    def __len__(self) -> int:
        return len(self.place_id)


class PlaceIndex(Protocol):
    """Descriptors of places that grow and are searched.

    Ids need not be unique: several descriptors may stand for one place.
    """

    length: int

    def add(
        self, place_id: int, descriptor: NDArray[np.floating], stamp_ns: int | None = None
    ) -> None:
        """Take in a descriptor [length].

        Args:
            place_id: what `search` answers with.
            descriptor: raises DataError when it has another length or is not finite.
            stamp_ns: when the place was seen; the entry waits until the delay is over. None: it
                belongs to an earlier drive and is found at once.
        """

    def search(
        self, descriptor: NDArray[np.floating], k: int, stamp_ns: int | None = None
    ) -> Neighbours:
        """Return up to k places, best first; `stamp_ns` is now, None leaves waiting ones out."""

    @property
    def searchable(self) -> int:
        """Entries that can be found: what counts as the database's size."""

    def __len__(self) -> int:
        """All entries, those that wait included."""

    def save(self, path: Path) -> None:
        """Write all entries; after loading, all are of an earlier drive."""
