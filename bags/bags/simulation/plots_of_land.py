"""Give out ground, so that nothing stands in a street or in something else."""

import numpy as np
from scipy.spatial import cKDTree

from lcd_common import se3


class Land:
    """Rectangles of ground that are taken, beside streets that stay free."""

    def __init__(
        self,
        street_points: se3.Array,
        half_width_m: se3.Array,
        squares: se3.Array | None = None,
    ) -> None:
        """Start with all ground free.

        Args:
            street_points: [N x 2] along all centrelines.
            half_width_m: [N] of the street at each of them.
            squares: [S x 3] centre and radius of squares, which stay open.
        """
        self._squares = np.empty((0, 3)) if squares is None else squares
        self._streets = cKDTree(street_points)
        self._half_width_m = half_width_m
        self._taken = np.zeros((256, 5))  # x y length width yaw
        self._reach = np.zeros(256)
        self._count = 0

    def from_kerb_m(self, points: se3.Array) -> se3.Array:
        """Return how far points [N x 2] are behind the nearest street's kerb; negative: on it."""
        distance, index = self._streets.query(points)
        return np.asarray(distance - self._half_width_m[index])

    def on_square(self, points: se3.Array) -> np.ndarray:
        """Return whether points [N x 2] are on an open square [N]."""
        apart = np.linalg.norm(points[:, None] - self._squares[:, :2], axis=2)
        return np.asarray((apart < self._squares[:, 2]).any(axis=1))

    def claim(
        self,
        centre: se3.Array,
        length: float,
        width: float,
        yaw: float,
        from_kerb_m: float,
        on_squares: bool = False,
    ) -> bool:
        """Take a rectangle if it is free, far enough behind every kerb, and off the squares.

        What may stand on squares as well is asked for with `on_squares`.
        """
        outline = _outline(centre, length, width, yaw)
        if self.from_kerb_m(outline).min() < from_kerb_m:
            return False
        if not on_squares and self.on_square(outline).any():
            return False
        reach = 0.5 * float(np.hypot(length, width))
        n = self._count
        apart = np.linalg.norm(self._taken[:n, :2] - centre, axis=1)
        for index in np.flatnonzero(apart < reach + self._reach[:n]):
            x, y, *other = self._taken[index]
            at = np.array([x, y])
            if _inside(outline, at, *other) or _inside(
                _outline(at, *other), centre, length, width, yaw
            ):
                return False
        if n == len(self._taken):
            self._taken = np.concatenate([self._taken, np.zeros_like(self._taken)])
            self._reach = np.concatenate([self._reach, np.zeros_like(self._reach)])
        self._taken[n], self._reach[n] = (*centre, length, width, yaw), reach
        self._count += 1
        return True


def _outline(centre: se3.Array, length: float, width: float, yaw: float) -> se3.Array:
    c, s = np.cos(yaw), np.sin(yaw)
    nx, ny = max(2, int(length) + 1), max(2, int(width) + 1)
    x, y = np.linspace(-length / 2, length / 2, nx), np.linspace(-width / 2, width / 2, ny)
    edge = np.concatenate(
        [
            np.column_stack([x, np.full(nx, y[0])]),
            np.column_stack([x, np.full(nx, y[-1])]),
            np.column_stack([np.full(ny, x[0]), y]),
            np.column_stack([np.full(ny, x[-1]), y]),
            np.zeros((1, 2)),
        ]
    )
    return np.asarray(edge @ np.array([[c, s], [-s, c]]) + centre)


def _inside(points: se3.Array, centre: se3.Array, length: float, width: float, yaw: float) -> bool:
    c, s = np.cos(yaw), np.sin(yaw)
    local = (points - centre) @ np.array([[c, -s], [s, c]])
    return bool(np.any((np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 1]) < width / 2)))
