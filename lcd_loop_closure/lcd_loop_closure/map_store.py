"""Save a map so that neither a kill nor a full disk can lose one, and load it with suspicion.

A saved map is a folder:

    meta.json               format, version, counts, and size and CRC-32 of every other file
    graph.npz               poses, odometry, loops with verdicts, satellite fixes (GraphSnapshot)
    descriptors.npz         values, lengths and methods
    clouds/000000.npz ...   compact keyframe clouds, 500 keyframes a file
    trajectory.tum, poses_kitti.txt, graph.g2o     the same result for other tools; not read back

Nothing is pickled. A save writes a folder beside the target, flushes it to the disk, and then
renames it into place; the old map is removed only after that.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError, MapError
from lcd_loop_closure.compact_cloud import CompactCloud
from lcd_loop_closure.graph_arrays import arrays_of, snapshot_from
from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.map_exports import write_exports
from lcd_loop_closure.map_folder import replaced, settle

FORMAT, VERSION = 'lcd_map', 1
META = 'meta.json'
_CHUNK = 500


@dataclass(frozen=True)
class Descriptor:
    """A descriptor and the name of its method."""

    method: str
    values: NDArray[np.float32]


@dataclass(frozen=True)
class SavedMap:
    """All that a map is made of; `clouds` and `descriptors` are in the order of the graph's ids."""

    graph: GraphSnapshot
    clouds: tuple[CompactCloud, ...]
    descriptors: tuple[Descriptor | None, ...]

    def __post_init__(self) -> None:
        counts = len(self.graph), len(self.clouds), len(self.descriptors)
        if len(set(counts)) != 1:
            raise DataError(
                'a map needs one cloud and one descriptor (or None) for each keyframe, '
                f'got {counts[0]} keyframes, {counts[1]} clouds and {counts[2]} descriptors'
            )

    def keyframe(self, row: int) -> Keyframe:
        """Return the keyframe in a row of the graph, with its cloud."""
        graph, descriptor = self.graph, self.descriptors[row]
        return Keyframe(
            id=int(graph.ids[row]),
            stamp_ns=int(graph.stamps_ns[row]),
            T_odom_base=graph.T_odom_base[row],
            T_previous_this=graph.motions[row],
            motion_covariance=graph.motion_covariances[row],
            cloud=self.clouds[row].cloud(),
            descriptor=None if descriptor is None else descriptor.values,
            descriptor_method='' if descriptor is None else descriptor.method,
        )

    def keyframes(self) -> tuple[Keyframe, ...]:
        """Return all keyframes with their clouds, as loop detection wants them."""
        return tuple(self.keyframe(row) for row in range(len(self.graph)))


def save_map(saved: SavedMap, path: str | Path) -> Path:
    """Write a map; a map that is there already stays until the new one is complete.

    Returns:
        The folder, absolute.

    Raises:
        MapError: the path is empty or holds something that is no map, another process saves there,
            or the disk does not take it.
    """
    if not str(path):
        raise MapError('a map needs a folder to be saved in, got an empty path')
    target = Path(path).expanduser().absolute()
    try:
        with replaced(target) as folder:
            _write(saved, folder)
    except OSError as error:
        raise MapError(f'{target}: the map could not be saved: {error}') from error
    return target


def load_map(path: str | Path) -> SavedMap:
    """Read a map.

    Raises:
        MapError: there is none, or it is incomplete, damaged or of another version.
    """
    if not str(path):
        raise MapError('expected the folder of a saved map, got an empty path')
    folder = Path(path).expanduser().absolute()
    settle(folder)
    meta = _read_meta(folder)
    try:
        for name, expected in meta['files'].items():
            _check_file(folder / name, expected)
        graph = snapshot_from(_arrays(folder / 'graph.npz'))
        clouds = [
            cloud
            for first in range(0, len(graph), _CHUNK)
            for cloud in _read_clouds(folder / _cloud_file(first))
        ]
        descriptors = _read_descriptors(folder / 'descriptors.npz')
        return SavedMap(graph, tuple(clouds), descriptors)
    except (DataError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise MapError(
            f'{folder}: not a readable map of version {VERSION} ({error}); save it anew'
        ) from error


def _write(saved: SavedMap, folder: Path) -> None:
    (folder / 'clouds').mkdir()
    np.savez(folder / 'graph.npz', allow_pickle=False, **arrays_of(saved.graph))
    _write_descriptors(saved.descriptors, folder / 'descriptors.npz')
    for first in range(0, len(saved.clouds), _CHUNK):
        _write_clouds(saved.clouds[first : first + _CHUNK], folder / _cloud_file(first))
    write_exports(saved.graph, folder)
    files = sorted(p for p in folder.rglob('*') if p.is_file())
    meta = {
        'format': FORMAT,
        'version': VERSION,
        'keyframes': len(saved.graph),
        'loops': len(saved.graph.loops),
        'files': {p.relative_to(folder).as_posix(): _fingerprint(p) for p in files},
    }
    (folder / META).write_text(json.dumps(meta, indent=2) + '\n')


def _read_meta(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise MapError(f'{folder}: expected the folder of a saved map, found none; check the path')
    try:
        meta = json.loads((folder / META).read_text())
    except FileNotFoundError:
        raise MapError(f'{folder}: not a saved map: it has no {META}; check the path') from None
    except (OSError, ValueError) as error:
        raise MapError(f'{folder / META}: not readable ({error}); save the map anew') from None
    if not isinstance(meta, dict) or meta.get('format') != FORMAT:
        raise MapError(f'{folder / META}: expected the format {FORMAT}; this is another file')
    if meta.get('version') != VERSION:
        raise MapError(
            f'{folder}: a map of version {meta.get("version")}, expected {VERSION}; '
            'load it with the release that saved it, or map anew'
        )
    if not isinstance(meta.get('files'), dict) or 'graph.npz' not in meta['files']:
        raise MapError(f'{folder / META}: it lists no files; save the map anew')
    return meta


def _fingerprint(path: Path) -> dict[str, int]:
    crc = 0
    with path.open('rb') as file:
        while block := file.read(1 << 20):
            crc = zlib.crc32(block, crc)
    return {'bytes': path.stat().st_size, 'crc32': crc}


def _check_file(path: Path, expected: Mapping[str, int]) -> None:
    if not path.is_file():
        raise MapError(f'{path}: missing; the map is incomplete, restore the file or save anew')
    found = _fingerprint(path)
    if found['bytes'] != expected['bytes']:
        raise MapError(
            f'{path}: expected {expected["bytes"]} bytes, got {found["bytes"]}; '
            'the file was cut or changed, save the map anew'
        )
    if found['crc32'] != expected['crc32']:
        raise MapError(f'{path}: its checksum is wrong: the file is damaged, save the map anew')


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise MapError(f'{path}: not readable ({error}); save the map anew') from None


def _cloud_file(first: int) -> str:
    return f'clouds/{first:06d}.npz'


def _write_clouds(clouds: tuple[CompactCloud, ...], path: Path) -> None:
    intensities = [cloud.intensity for cloud in clouds if cloud.intensity is not None]
    np.savez(
        path,
        steps=np.concatenate([cloud.steps for cloud in clouds]),
        step_m=np.array([cloud.step_m for cloud in clouds]),
        counts=np.array([len(cloud) for cloud in clouds]),
        has_intensity=np.array([cloud.intensity is not None for cloud in clouds]),
        intensity=np.concatenate([np.empty(0, np.float16), *intensities]),
    )


def _read_clouds(path: Path) -> list[CompactCloud]:
    data = _arrays(path)
    counts, has_intensity = data['counts'], data['has_intensity']
    steps = np.split(data['steps'], np.cumsum(counts)[:-1])
    intensities = iter(np.split(data['intensity'], np.cumsum(counts[has_intensity])[:-1]))
    if counts.sum() != len(data['steps']) or counts[has_intensity].sum() != len(data['intensity']):
        raise MapError(f'{path}: its counts do not add up to its points; save the map anew')
    return [
        CompactCloud(part, float(step_m), next(intensities) if has else None)
        for part, step_m, has in zip(steps, data['step_m'], has_intensity, strict=True)
    ]


def _write_descriptors(descriptors: tuple[Descriptor | None, ...], path: Path) -> None:
    known = [d for d in descriptors if d is not None]
    np.savez(
        path,
        methods=np.array([d.method if d is not None else '' for d in descriptors], dtype=np.str_),
        lengths=np.array([d.values.size if d is not None else -1 for d in descriptors], np.int64),
        values=np.concatenate([np.empty(0, np.float32), *(d.values.ravel() for d in known)]),
    )


def _read_descriptors(path: Path) -> tuple[Descriptor | None, ...]:
    data = _arrays(path)
    lengths = data['lengths']
    ends = np.cumsum(np.maximum(lengths, 0))
    if len(ends) and ends[-1] != len(data['values']):
        raise MapError(f'{path}: its lengths do not add up to its values; save the map anew')
    if not np.isfinite(data['values']).all():
        raise MapError(f'{path}: a descriptor is not finite; save the map anew')
    return tuple(
        None if length < 0 else Descriptor(str(method), data['values'][end - length : end])
        for method, length, end in zip(data['methods'], lengths, ends, strict=True)
    )
