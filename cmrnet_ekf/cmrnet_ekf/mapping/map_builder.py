"""Build a tiled map from sweeps with poses, a part at a time."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.sight import Sight, seen_through, sight_of
from cmrnet_ekf.mapping.tile_folder import Points, Tile, TileFolder, TilePoints
from lcd_common import se3
from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.errors import DataError

_CELL_M = 0.3  # of the count of neighbours
_ROW = 1 << 16  # voxels of a tile's side and of its height fit


class MapBuilder:
    """Put sweeps into the tiles of a folder; memory holds a buffer and one tile.

    The first point of a voxel stays, as it was measured. `finish` writes what is left and judges
    the tiles that changed. A folder that is there already is gone on with: what has moved since
    is seen through by the new sweeps.
    """

    def __init__(self, folder: TileFolder, settings: MapConfig) -> None:
        self.settings, self.folder = settings, folder
        self._new: dict[Tile, list[Points]] = defaultdict(list)
        self._waiting = 0
        self._sights: list[Sight] = []
        self._asked: se3.Array | None = None
        self._changed: set[Tile] = set()
        self.sweeps = 0

    def add(
        self,
        cloud: PointCloud,
        T_map_base: se3.Array,
        T_base_sensor: se3.Array,
        moving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add a sweep.

        Args:
            cloud: sensor frame.
            T_map_base: pose of the vehicle.
            T_base_sensor: where the sensor sits.
            moving: [N] points known to lie on what moves, by labels; they are left out.

        Raises:
            DataError: the pose is not finite.
        """
        if not np.isfinite(T_map_base).all():
            raise DataError('a sweep cannot be mapped with a pose that is not finite')
        s = self.settings
        if moving is not None:
            cloud = cloud.select(~moving)
        cloud = cloud.finite()
        self._look(cloud, T_map_base, T_base_sensor)
        base = cloud.transformed(T_base_sensor).within(0.0, s.max_range).xyz
        base = base[np.abs(base[:, :2]).max(axis=1, initial=0.0) > s.vehicle]
        self.sweeps += 1
        if not len(base):
            return
        in_map = base.astype(np.float64) @ T_map_base[:3, :3].T + T_map_base[:3, 3]
        in_map = in_map[voxel_first(in_map, s.voxel)]
        for tile, points in self._by_tile(in_map):
            self._new[tile].append(points)
            self._waiting += len(points)
        if self._waiting > s.buffer:
            self.write()

    def write(self) -> None:
        """Merge what waits into the tiles, and let sweeps tell what they saw through."""
        for tile, parts in self._new.items():
            self.folder.write(tile, self._merged(self.folder.read(tile), parts))
            self._changed.add(tile)
        for tile in self.folder.tiles() if self._sights else []:
            self._ask(tile)
        self._new.clear()
        self._sights.clear()
        self._waiting = 0

    def finish(self) -> int:
        """Write the rest and decide what stays; returns how many points do, in changed tiles."""
        self.write()
        staying = 0
        for tile in sorted(self._changed):
            found = self.folder.read(tile)
            stays = self._judge(found)
            self.folder.write(tile, replace(found, stays=stays))
            staying += int(stays.sum())
        self._changed.clear()
        return staying

    def _look(self, cloud: PointCloud, T_map_base: se3.Array, T_base_sensor: se3.Array) -> None:
        s = self.settings
        if not s.see_through:
            return
        if self._asked is not None:
            way = np.linalg.norm(T_map_base[:3, 3] - self._asked[:3, 3])
            if way < s.evidence_spacing:
                return
        self._asked = T_map_base
        self._sights.append(sight_of(cloud.xyz, T_map_base @ T_base_sensor))

    def _by_tile(self, in_map: NDArray[np.float64]) -> Iterator[tuple[Tile, Points]]:
        side = self.folder.tile
        tile_of = np.floor(in_map[:, :2] / side).astype(np.int64)
        order = np.lexsort((tile_of[:, 1], tile_of[:, 0]))
        ends = np.flatnonzero(np.any(np.diff(tile_of[order], axis=0), axis=1)) + 1
        for part in np.split(order, ends):
            tile = (int(tile_of[part[0], 0]), int(tile_of[part[0], 1]))
            yield tile, (in_map[part] - self.folder.corner(tile)).astype(np.float32)

    def _merged(self, old: TilePoints, parts: list[Points]) -> TilePoints:
        """Return a tile with new points: sweeps have one point a voxel each."""
        points = np.concatenate(parts)
        cell = np.floor(points / self.folder.voxel).astype(np.int64)
        keys = (cell[:, 0] * _ROW + cell[:, 1]) * _ROW + cell[:, 2] + _ROW // 2
        new, first, hits = np.unique(keys, return_index=True, return_counts=True)
        at = np.searchsorted(old.keys, new)
        known = np.zeros(len(new), bool)
        known[at < len(old.keys)] = old.keys[at[at < len(old.keys)]] == new[at < len(old.keys)]
        all_hits = old.hits.copy()
        all_hits[at[known]] += hits[known].astype(np.int32)
        into, fresh = at[~known], first[~known]
        zeros = np.zeros(len(fresh), np.int32)
        return TilePoints(
            np.insert(old.keys, into, new[~known]),
            np.insert(old.points, into, points[fresh], axis=0),
            np.insert(all_hits, into, hits[~known].astype(np.int32)),
            np.insert(old.through, into, zeros),
            np.insert(old.stays, into, zeros.astype(bool)),
        )

    def _ask(self, tile: Tile) -> None:
        """Count which of the waiting sweeps saw through the points of a tile."""
        reach = self.settings.evidence_range
        half = 0.5 * self.folder.tile
        middle = self.folder.corner(tile)[:2] + half
        near = [
            sight
            for sight in self._sights
            if np.linalg.norm(se3.inverse(sight.T_sensor_map)[:2, 3] - middle) < reach + 1.5 * half
        ]
        if not near:
            return
        found = self.folder.read(tile)
        # Sights are moved to the tile's corner: there float32 is exact to less than a micrometre.
        T_map_tile = se3.from_rotation_translation(np.eye(3), self.folder.corner(tile))
        through = found.through.copy()
        for sight in near:
            there = replace(sight, T_sensor_map=sight.T_sensor_map @ T_map_tile)
            through += seen_through(found.points, there, reach)
        if (through != found.through).any():
            self.folder.write(tile, replace(found, through=through))
            self._changed.add(tile)

    def _judge(self, found: TilePoints) -> NDArray[np.bool_]:
        s = self.settings
        moved = (found.through >= s.evidence_votes) & (
            found.hits <= s.evidence_ratio * found.through
        )
        stays = ~moved
        if s.neighbours:
            stays[stays] = neighbours(found.points[stays]) >= s.neighbours
        return np.asarray(stays)


def neighbours(points: Points) -> NDArray[np.int64]:
    """Return how many other points lie in the 27 cells (0.3 m) around each point [N x 3]."""
    if not len(points):
        return np.empty(0, np.int64)
    cell = np.floor(points / _CELL_M).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    spans = cell.max(axis=0) + 2
    keys = (cell[:, 0] * spans[1] + cell[:, 1]) * spans[2] + cell[:, 2]
    occupied, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    total = np.zeros(len(occupied), np.int64)
    for shift in np.ndindex(3, 3, 3):
        dx, dy, dz = np.array(shift) - 1
        wanted = occupied + (dx * spans[1] + dy) * spans[2] + dz
        at = np.minimum(np.searchsorted(occupied, wanted), len(occupied) - 1)
        total += np.where(occupied[at] == wanted, counts[at], 0)
    return np.asarray(total[inverse] - 1, np.int64)
