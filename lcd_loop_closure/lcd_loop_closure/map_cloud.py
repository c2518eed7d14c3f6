"""Assemble the map cloud from keyframe clouds, touching only what changed."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting

Tile = tuple[int, int]
Points = NDArray[np.float32]


@config
class MapCloudConfig:
    """How the map cloud is made."""

    voxel: float = setting(0.5, 'one point is kept in each voxel of the map', unit='m', low=0.05)
    range: float = setting(
        50.0, 'points farther from their keyframe are left out', unit='m', low=1.0
    )
    tile: float = setting(50.0, 'side of the tiles that are rebuilt as a whole', unit='m', low=5.0)


class MapCloud:
    """Hold the voxelised map in square tiles.

    A new keyframe adds points where voxels are empty. A keyframe that moved by more than half a
    voxel (measured at `range`) has the tiles it lies in and lay in rebuilt; one that moved less
    stays where it was. In each voxel the point of the keyframe with the smallest id is kept, so
    the result does not depend on how the updates were cut.
    """

    def __init__(
        self, settings: MapCloudConfig, points_of: Callable[[int], NDArray[np.floating]]
    ) -> None:
        """Make an empty map.

        Args:
            settings: voxel, range and tile size.
            points_of: returns the points [N x 3] of a keyframe in its base frame, by id.
        """
        self.settings = settings
        self._points_of = points_of
        self._T_map_base: dict[int, se3.Array] = {}  # as included
        self._tiles: dict[Tile, _Tile] = {}
        self._keyframes_of: dict[Tile, set[int]] = {}
        self._tiles_of: dict[int, list[Tile]] = {}

    def update(self, T_map_base: Mapping[int, se3.Array]) -> int:
        """Bring the map to the given poses.

        Args:
            T_map_base: pose [4 x 4] of every keyframe by id.

        Returns:
            How many keyframes were looked at: 0 when nothing changed.
        """
        moved = [id_ for id_ in self._T_map_base if self._moved(id_, T_map_base[id_])]
        new = [id_ for id_ in T_map_base if id_ not in self._T_map_base]
        stale: set[Tile] = set()
        for id_ in moved:
            stale.update(self._forget(id_))
            # Where it moves to must be rebuilt too: there its points may come before others'.
            stale.update(tile for tile, _, _ in self._split(id_, T_map_base[id_]))
        redo = sorted(set(new) | set(moved).union(*(self._keyframes_of.get(t, ()) for t in stale)))
        for tile in stale:
            self._tiles.pop(tile, None)
        for id_ in redo:
            known = id_ in self._T_map_base
            if not known:
                self._T_map_base[id_] = np.array(T_map_base[id_])
                self._tiles_of[id_] = []
            for tile, keys, points in self._split(id_, self._T_map_base[id_]):
                if known and tile not in stale:
                    continue
                if not known:
                    self._tiles_of[id_].append(tile)
                    self._keyframes_of.setdefault(tile, set()).add(id_)
                self._tiles.setdefault(tile, _Tile()).add(keys, points)
        return len(redo)

    def points(self) -> Points:
        """Return all points [N x 3], metres, map frame."""
        if not self._tiles:
            return np.empty((0, 3), np.float32)
        return np.concatenate([self._tiles[tile].points for tile in sorted(self._tiles)])

    def _moved(self, id_: int, T_map_base: se3.Array) -> bool:
        T = self._T_map_base[id_]
        shift = float(np.abs(T[:3, 3] - T_map_base[:3, 3]).sum())
        turn = float(np.linalg.norm(T[:3, :3] - T_map_base[:3, :3]))  # >= the angle, for small ones
        return shift + turn * self.settings.range > 0.5 * self.settings.voxel

    def _forget(self, id_: int) -> list[Tile]:
        del self._T_map_base[id_]
        tiles = self._tiles_of.pop(id_)
        for tile in tiles:
            self._keyframes_of[tile].discard(id_)
        return tiles

    def _split(
        self, id_: int, T_map_base: se3.Array
    ) -> Iterator[tuple[Tile, NDArray[np.int64], Points]]:
        """Yield tile, voxel keys (sorted, unique) and points of a keyframe for each tile."""
        points = self._points_of(id_)
        near = np.einsum('ij,ij->i', points, points) <= self.settings.range**2
        in_map = points[near].astype(np.float64) @ T_map_base[:3, :3].T + T_map_base[:3, 3]
        cell = np.floor(in_map / self.settings.voxel).astype(np.int64)
        side = max(1, round(self.settings.tile / self.settings.voxel))
        tile_of = cell[:, :2] // side
        inside = cell[:, :2] - tile_of * side
        key = ((inside[:, 0] * side + inside[:, 1]) << 32) + cell[:, 2] + (1 << 31)
        order = np.lexsort((key, tile_of[:, 1], tile_of[:, 0]))  # stable: the first point is kept
        tile_of, key, in_map = tile_of[order], key[order], in_map[order]
        ends = np.flatnonzero(np.any(np.diff(tile_of, axis=0), axis=1)) + 1
        for start, end in zip([0, *ends], [*ends, len(key)], strict=True):
            if start == end:
                continue
            keys, first = np.unique(key[start:end], return_index=True)
            tile = (int(tile_of[start, 0]), int(tile_of[start, 1]))
            yield tile, keys, in_map[start:end][first].astype(np.float32)


class _Tile:
    """One point for each occupied voxel, ordered by voxel key."""

    def __init__(self) -> None:
        self.keys = np.empty(0, np.int64)
        self.points: Points = np.empty((0, 3), np.float32)

    def add(self, keys: NDArray[np.int64], points: Points) -> None:
        """Fill voxels that are empty."""
        at = np.searchsorted(self.keys, keys)
        taken = np.zeros(len(keys), bool)
        inner = at < len(self.keys)
        taken[inner] = self.keys[at[inner]] == keys[inner]
        free = ~taken
        self.keys = np.insert(self.keys, at[free], keys[free])
        self.points = np.insert(self.points, at[free], points[free], axis=0)
