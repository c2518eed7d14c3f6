"""Keep the tiles of a map in a folder: one file each, written as a whole or not at all.

    meta.json        format, version, and the settings that all tiles share
    tiles/X_Y.npz    voxel keys, points, how many sweeps hit a voxel and saw through it, what stays

Points are float32 metres from the tile's corner: nothing is lost far from the origin.
"""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.mapping.settings import MapConfig
from lcd_common.errors import MapError

Tile = tuple[int, int]
Points = NDArray[np.float32]
FORMAT, VERSION = 'lidar_map', 1


@dataclass(frozen=True)
class TilePoints:
    """The voxels of one tile, ordered by key.

    Attributes:
        keys: [N] int64 of the voxels within the tile.
        points: [N x 3] float32, metres from the tile's corner (x, y) and height 0 of the map (z).
        hits: [N] sweeps that measured something there.
        through: [N] sweeps that saw through it.
        stays: [N] neither an outlier nor moved.
    """

    keys: NDArray[np.int64]
    points: Points
    hits: NDArray[np.int32]
    through: NDArray[np.int32]
    stays: NDArray[np.bool_]

    @classmethod
    def empty(cls) -> 'TilePoints':
        """Return a tile without points."""
        return cls(
            np.empty(0, np.int64),
            np.empty((0, 3), np.float32),
            np.empty(0, np.int32),
            np.empty(0, np.int32),
            np.empty(0, np.bool_),
        )


class TileFolder:
    """A map's folder."""

    def __init__(self, path: Path, voxel: float, tile: float) -> None:
        self.path, self.voxel, self.tile = path, voxel, tile

    @classmethod
    def create(cls, path: Path, settings: MapConfig) -> 'TileFolder':
        """Make a new map, or open one to go on with.

        Raises:
            MapError: the folder holds something else, or a map of another voxel or tile size.
        """
        if (path / 'meta.json').is_file():
            folder = cls.open(path)
            if (folder.voxel, folder.tile) != (settings.voxel, settings.tile):
                raise MapError(
                    f'{path}: has voxels of {folder.voxel:g} m and tiles of {folder.tile:g} m, '
                    f'asked are {settings.voxel:g} and {settings.tile:g}; use the same, or another '
                    'folder'
                )
            return folder
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise MapError(f'{path}: is neither empty nor a LiDAR map; choose another folder')
        (path / 'tiles').mkdir(parents=True, exist_ok=True)
        meta = {
            'format': FORMAT,
            'version': VERSION,
            'voxel': settings.voxel,
            'tile': settings.tile,
        }
        (path / 'meta.json').write_text(json.dumps(meta, indent=1) + '\n')
        return cls(path, settings.voxel, settings.tile)

    @classmethod
    def open(cls, path: Path) -> 'TileFolder':
        """Open a map; raises MapError when there is none of this version."""
        try:
            meta = json.loads((path / 'meta.json').read_text())
            voxel, tile = float(meta['voxel']), float(meta['tile'])
        except FileNotFoundError:
            raise MapError(
                f'{path}: no LiDAR map: it has no meta.json; build one with build_lidar_map'
            ) from None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise MapError(
                f'{path}/meta.json: not readable ({error}); build the map anew'
            ) from None
        if meta.get('format') != FORMAT or meta.get('version') != VERSION:
            raise MapError(
                f'{path}: expected a {FORMAT} of version {VERSION}, got '
                f'{meta.get("format")} of version {meta.get("version")}'
            )
        return cls(path, voxel, tile)

    def tiles(self) -> list[Tile]:
        """List the tiles there are."""
        return sorted(
            (int(x), int(y))
            for x, y in (file.stem.split('_') for file in (self.path / 'tiles').glob('*_*.npz'))
        )

    def read(self, tile: Tile) -> TilePoints:
        """Return a tile; an empty one where there is none.

        Raises:
            MapError: the file is damaged.
        """
        file = self._file(tile)
        if not file.is_file():
            return TilePoints.empty()
        try:
            with np.load(file, allow_pickle=False) as data:
                found = TilePoints(*(data[name] for name in _NAMES))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise MapError(f'{file}: not readable ({error}); build the map anew') from None
        if len({len(getattr(found, name)) for name in _NAMES}) != 1:
            raise MapError(f'{file}: its parts have different lengths; build the map anew')
        return found

    def write(self, tile: Tile, points: TilePoints) -> None:
        """Replace a tile; a kill leaves the old one."""
        file = self._file(tile)
        part = file.with_suffix('.part')
        with part.open('wb') as out:
            np.savez(out, allow_pickle=False, **{n: getattr(points, n) for n in _NAMES})
        part.replace(file)

    def corner(self, tile: Tile) -> NDArray[np.float64]:
        """Return the origin [3] of a tile's points in the map."""
        return np.array([tile[0] * self.tile, tile[1] * self.tile, 0.0])

    def clouds(self) -> Iterator[NDArray[np.float64]]:
        """Yield what stays of each tile [N x 3], map frame."""
        for tile in self.tiles():
            found = self.read(tile)
            yield found.points[found.stays] + self.corner(tile)

    def _file(self, tile: Tile) -> Path:
        return self.path / 'tiles' / f'{tile[0]}_{tile[1]}.npz'


_NAMES = ('keys', 'points', 'hits', 'through', 'stays')
