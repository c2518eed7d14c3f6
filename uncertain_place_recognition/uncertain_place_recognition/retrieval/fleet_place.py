"""Say how a place is written where all vehicles of a fleet read it, and how they name it."""

import math
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lcd_common import se3
from lcd_common.errors import DataError
from uncertain_place_recognition.place import Place

_NAMESPACE = uuid.UUID('6b1f4f0e-6a0c-5d53-9a0b-0c6a2c0e7d11')
_ELSEWHERE = 2**62  # numbers of a vehicle's own places lie below


@dataclass(frozen=True)
class FleetPlace:
    """A place that another vehicle added, or this one on another drive.

    Attributes:
        vehicle: its name.
        number: of the place in that vehicle's map.
        place: with the id by which everybody else names it (`elsewhere_id`).
    """

    vehicle: str
    number: int
    place: Place


def place_key(ensemble: str, vehicle: str, number: int, stamp_ns: int) -> uuid.UUID:
    """Return the key of an entry: the same place written twice is one entry.

    The stamp is part of it because the next drive of a vehicle may number its places from 0 again.
    """
    return uuid.uuid5(_NAMESPACE, f'{ensemble}\n{vehicle}\n{number}\n{stamp_ns}')


def elsewhere_id(key: uuid.UUID) -> int:
    """Return the id of a place that is not in this vehicle's map: 2^62 and 62 bits of its key.

    The same on every vehicle and on every day, and never a number that a vehicle counts to.
    """
    return _ELSEWHERE | (key.int & (_ELSEWHERE - 1))


def is_elsewhere(place_id: int) -> bool:
    """Tell whether an id names a place that is not in this vehicle's map."""
    return place_id >= _ELSEWHERE


def tile_of(T_map_base: se3.Array, side_m: float) -> str:
    """Return the square tile of the map in which a pose lies: column (x) and row (y)."""
    x, y = T_map_base[:2, 3]
    return f'{math.floor(x / side_m)}:{math.floor(y / side_m)}'


def tiles_around(x: float, y: float, radius_m: float, side_m: float) -> list[str]:
    """Return the tiles that a square of 2 x radius about a point touches."""
    columns, rows = (
        range(math.floor((at - radius_m) / side_m), math.floor((at + radius_m) / side_m) + 1)
        for at in (x, y)
    )
    return [f'{column}:{row}' for column in columns for row in rows]


def pose_payload(place: Place, side_m: float) -> dict[str, Any]:
    """Return what an entry says of where a place is."""
    covariance = place.covariance
    return {
        'T_map_base': np.asarray(place.T_map_base, np.float64).ravel().tolist(),
        'covariance': None if covariance is None else np.asarray(covariance).ravel().tolist(),
        'cell': tile_of(place.T_map_base, side_m),
    }


def fleet_place(key: str, payload: Mapping[str, Any]) -> FleetPlace | None:
    """Return the place that an entry describes; None of one that says not where it is.

    Raises:
        DataError: the entry is damaged.
    """
    if payload.get('T_map_base') is None:
        return None
    try:
        T_map_base = np.reshape(np.array(payload['T_map_base'], np.float64), (4, 4))
        told = payload.get('covariance')
        covariance = None if told is None else np.reshape(np.array(told, np.float64), (6, 6))
        vehicle, number = str(payload['vehicle']), int(payload['place_id'])
        float(payload['length'])
        id = elsewhere_id(uuid.UUID(key))
        place = Place(id, int(payload['stamp_ns']), T_map_base, covariance)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f'entry {key} of the shared map is damaged ({error}); delete it') from None
    known = [T_map_base] if covariance is None else [T_map_base, covariance]
    if not all(np.isfinite(array).all() for array in known):
        raise DataError(f'entry {key} of the shared map has a pose that is not finite; delete it')
    return FleetPlace(vehicle, number, place)
