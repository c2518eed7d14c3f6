"""Load the tiles around the vehicle, and keep them while it is near."""

from collections import OrderedDict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.mapping.tile_folder import Tile, TileFolder
from lcd_common import se3
from lcd_common.errors import MapError
from lcd_common.settings import config, setting


@config
class LocalMapConfig:
    """What is loaded: a box around the vehicle, by default what CMRNet's authors took."""

    ahead: float = setting(100.0, 'reach to the front', unit='m', low=1.0)
    behind: float = setting(10.0, 'reach to the back', unit='m', low=0.0)
    beside: float = setting(25.0, 'reach to each side', unit='m', low=1.0)
    kept_tiles: int = setting(200, 'tiles that stay in memory', low=1)


class LocalMap:
    """The part of a map around the vehicle."""

    def __init__(self, path: Path, settings: LocalMapConfig | None = None) -> None:
        """Open a map.

        Raises:
            MapError: there is none, or it has no points.
        """
        self.settings = settings or LocalMapConfig()
        self.path = path
        self._folder = TileFolder.open(path)
        self._there = set(self._folder.tiles())
        if not self._there:
            raise MapError(f'{path}: the map is empty; build it with build_lidar_map')
        self._kept: OrderedDict[Tile, NDArray[np.float32]] = OrderedDict()
        self._last: tuple[frozenset[Tile], NDArray[np.float64], NDArray[np.float32]] | None = None

    def around(self, T_map_base: se3.Array) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Return the points of all tiles that the box around a pose touches.

        Returns:
            Points [N x 3] float32 from an origin near the vehicle, along the map's axes, and this
            origin [3] in the map. Kept from call to call while the tiles are the same.
        """
        tiles = frozenset(self._touched(T_map_base))
        if self._last is None or self._last[0] != tiles:
            corner = np.floor(T_map_base[:2, 3] / self._folder.tile) * self._folder.tile
            origin = np.array([*corner, 0.0])
            parts = [
                self._tile(tile) + (self._folder.corner(tile) - origin).astype(np.float32)
                for tile in sorted(tiles)
            ]
            points = np.concatenate([np.empty((0, 3), np.float32), *parts])
            self._last = tiles, origin, points
        return self._last[2], self._last[1]

    def _touched(self, T_map_base: se3.Array) -> list[Tile]:
        s, side = self.settings, self._folder.tile
        corners = np.array(
            [[x, y, 0.0, 1.0] for x in (-s.behind, s.ahead) for y in (-s.beside, s.beside)]
        )
        in_map = (corners @ T_map_base.T)[:, :2]
        low, high = (np.floor(f(in_map, axis=0) / side).astype(int) for f in (np.min, np.max))
        # A tile is near enough when its middle lies in the box, grown by half its diagonal.
        grown = 0.5 * side * np.sqrt(2.0)
        T_base_map = se3.inverse(T_map_base)
        touched = []
        for x in range(low[0], high[0] + 1):
            for y in range(low[1], high[1] + 1):
                if (x, y) not in self._there:
                    continue
                middle = np.array([(x + 0.5) * side, (y + 0.5) * side, T_map_base[2, 3], 1.0])
                forward, left = (T_base_map @ middle)[:2]
                if -s.behind - grown <= forward <= s.ahead + grown and (
                    abs(left) <= s.beside + grown
                ):
                    touched.append((x, y))
        return touched

    def _tile(self, tile: Tile) -> NDArray[np.float32]:
        if tile in self._kept:
            self._kept.move_to_end(tile)
            return self._kept[tile]
        found = self._folder.read(tile)
        points = self._kept[tile] = found.points[found.stays]
        while len(self._kept) > self.settings.kept_tiles:
            self._kept.popitem(last=False)
        return points


def near_origin(T_map_base: se3.Array, origin: NDArray[np.float64]) -> se3.Array:
    """Return a pose in the frame of `LocalMap.around`'s points."""
    T = T_map_base.copy()
    T[:3, 3] -= origin
    return T
