"""Keep the places of a map in a folder, and read it with suspicion.

    meta.json               format, version, counts, hash of the ensemble's weights
    descriptors.npz         ids and mean descriptors, as the index of places writes them
    places.npz              ids, stamps, poses, covariances
    clouds/000000.npz ...   compact clouds, 500 places a file

Nothing is pickled. A save writes a folder beside the target and renames it into place.
"""

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError, MapError
from lcd_loop_closure.compact_cloud import CompactCloud
from lcd_loop_closure.map_folder import replaced, settle
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.retrieval.windowed_index import WindowedIndex

FORMAT, VERSION = 'lcd_places', 1
META = 'meta.json'
_CHUNK = 500
_OWN = re.compile(r'meta\.json|descriptors\.npz|places\.npz|clouds|clouds/\d+\.npz')


@dataclass(frozen=True)
class SavedPlaces:
    """What a folder holds beside the descriptors.

    Attributes:
        ensemble: hash of the weights that made the descriptors.
        places: in the order in which they came.
        clouds: of some or all places, by their id.
    """

    ensemble: str
    places: tuple[Place, ...]
    clouds: Mapping[int, CompactCloud]


def save_places(saved: SavedPlaces, index: WindowedIndex, path: str | Path) -> Path:
    """Write places with their descriptors; what was there stays until all is written.

    Returns:
        The folder, absolute.

    Raises:
        MapError: the path is empty or holds something else, or the disk does not take it.
    """
    if not str(path):
        raise MapError('places need a folder to be saved in, got an empty path')
    target = Path(path).expanduser().absolute()
    if (target / META).is_file() and _meta(target).get('format') != FORMAT:
        raise MapError(
            f'{target}: holds a map of another kind ({_meta(target).get("format")}); nothing was '
            'changed, choose another folder'
        )
    try:
        with replaced(target, _OWN) as folder:
            index.save(folder / 'descriptors.npz')
            np.savez(folder / 'places.npz', allow_pickle=False, **_arrays_of(saved.places))
            (folder / 'clouds').mkdir()
            clouds = sorted(saved.clouds.items())
            for first in range(0, len(clouds), _CHUNK):
                _write_clouds(clouds[first : first + _CHUNK], folder / f'clouds/{first:06d}.npz')
            meta = {
                'format': FORMAT,
                'version': VERSION,
                'ensemble': saved.ensemble,
                'places': len(saved.places),
                'clouds': len(clouds),
            }
            (folder / META).write_text(json.dumps(meta, indent=2) + '\n')
    except OSError as error:
        raise MapError(f'{target}: the places could not be saved: {error}') from error
    return target


def load_places(path: str | Path, ensemble: str, index: WindowedIndex) -> SavedPlaces:
    """Read places, and their descriptors into an empty index.

    Raises:
        MapError: there are none, they are damaged, or were made with other weights than
            `ensemble` (a hash); the index must then not be used.
    """
    if not str(path):
        raise MapError('expected the folder of saved places, got an empty path')
    folder = Path(path).expanduser().absolute()
    settle(folder)
    meta = _checked_meta(folder, ensemble)
    try:
        places = _places_from(_read(folder / 'places.npz'))
        ids, rows = index.read(folder / 'descriptors.npz')
        files = sorted((folder / 'clouds').glob('*.npz'))
        clouds = {id: cloud for file in files for id, cloud in _read_clouds(file)}
    except FileNotFoundError as error:
        raise MapError(f'{error.filename}: missing; the map is incomplete, save it anew') from None
    except (DataError, KeyError, TypeError, ValueError) as error:
        raise MapError(f'{folder}: not readable ({error}); save the map anew') from error
    counts = len(places), len(ids), len(clouds)
    if counts != (meta.get('places'), meta.get('places'), meta.get('clouds')):
        raise MapError(
            f'{folder}: expected {meta.get("places")} places with {meta.get("clouds")} clouds, got '
            f'{counts[0]} with {counts[1]} descriptors and {counts[2]} clouds; save the map anew'
        )
    if set(ids.tolist()) != {place.id for place in places}:
        raise MapError(f'{folder}: its descriptors are of other places; save the map anew')
    # Only now: what a shared index takes in, others see.
    index.note_poses(places)
    index.add_many(ids, rows)
    return SavedPlaces(ensemble, places, clouds)


def _checked_meta(folder: Path, ensemble: str) -> dict[str, Any]:
    if not (folder / META).is_file():
        raise MapError(f'{folder}: expected the folder of saved places, found none; check the path')
    meta = _meta(folder)
    if meta.get('format') == 'lcd_map':
        raise MapError(
            f'{folder}: is a map of pose_graph; expected the folder that place_recognition saved '
            'beside it'
        )
    if meta.get('format') != FORMAT or meta.get('version') != VERSION:
        raise MapError(
            f'{folder}: expected {FORMAT} of version {VERSION}, got {meta.get("format")} of '
            f'version {meta.get("version")}'
        )
    if meta.get('ensemble') != ensemble:
        raise MapError(
            f'{folder}: these places were described by another ensemble (weights '
            f'{str(meta.get("ensemble"))[:12]}, loaded are {ensemble[:12]}), whose descriptors '
            'cannot be compared: load that ensemble, or map anew'
        )
    return meta


def _meta(folder: Path) -> dict[str, Any]:
    try:
        meta = json.loads((folder / META).read_text())
    except (OSError, ValueError) as error:
        raise MapError(f'{folder / META}: not readable ({error}); save the map anew') from None
    if not isinstance(meta, dict):
        raise MapError(f'{folder / META}: holds no map; check the path')
    return meta


def _arrays_of(places: Sequence[Place]) -> dict[str, NDArray[Any]]:
    unknown = np.zeros((6, 6))
    return {
        'ids': np.array([p.id for p in places], np.int64),
        'stamps_ns': np.array([p.stamp_ns for p in places], np.int64),
        'T_map_base': np.reshape([p.T_map_base for p in places], (-1, 4, 4)),
        'covariances': np.reshape(
            [unknown if p.covariance is None else p.covariance for p in places], (-1, 6, 6)
        ),
    }


def _places_from(data: dict[str, NDArray[Any]]) -> tuple[Place, ...]:
    T_map_base, covariances = data['T_map_base'], data['covariances']
    if not np.isfinite(T_map_base).all() or not np.isfinite(covariances).all():
        raise DataError('a pose is not finite')
    rows = zip(data['ids'], data['stamps_ns'], T_map_base, covariances, strict=True)
    return tuple(Place(int(i), int(ns), T, C if C.any() else None) for i, ns, T, C in rows)


def _write_clouds(clouds: Sequence[tuple[int, CompactCloud]], path: Path) -> None:
    np.savez(
        path,
        allow_pickle=False,
        ids=np.array([id for id, _ in clouds], np.int64),
        steps=np.concatenate([cloud.steps for _, cloud in clouds]),
        step_m=np.array([cloud.step_m for _, cloud in clouds]),
        counts=np.array([len(cloud) for _, cloud in clouds], np.int64),
    )


def _read_clouds(path: Path) -> list[tuple[int, CompactCloud]]:
    data = _read(path)
    if data['counts'].sum() != len(data['steps']):
        raise DataError(f'{path.name}: its counts do not add up to its points')
    parts = np.split(data['steps'], np.cumsum(data['counts'])[:-1])
    rows = zip(data['ids'], parts, data['step_m'], strict=True)
    return [(int(id), CompactCloud(part, float(step_m))) for id, part, step_m in rows]


def _read(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise MapError(f'{path}: not readable ({error}); save the map anew') from None
