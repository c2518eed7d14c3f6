"""Build a town along streets: no two places of it look alike."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bags.street import shapes
from bags.street.mesh import Label, Material, Mesh, MeshBuilder

Array = NDArray[np.float64]
# foot of the thing, unit vectors along the street and away from it, the street's yaw -> its length
Place = Callable[[Array, Array, Array, float], float]
KERB_M = 5.3
_REACH_M = 75.0
_CELL_M = 1.0


class Ground:
    """Rolling ground: a few long waves with at most about 5 % slope."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._length = rng.uniform(110.0, 260.0, 4)
        self._heading = rng.uniform(0.0, 2 * np.pi, 4)
        self._phase = rng.uniform(0.0, 2 * np.pi, 4)
        self._height = self._length * rng.uniform(0.0008, 0.0022, 4)

    def height(self, xy: Array) -> Array:
        """Return the height [N] in metres at points [N x 2], streets' details left out."""
        return np.asarray((self._height * np.sin(self._waves(xy))).sum(axis=1))

    def slope(self, xy: Array) -> Array:
        """Return the gradient [N x 2] of the height."""
        k = 2 * np.pi / self._length
        amount = self._height * k * np.cos(self._waves(xy))
        return np.stack(
            [(amount * np.cos(self._heading)).sum(1), (amount * np.sin(self._heading)).sum(1)], 1
        )

    def _waves(self, xy: Array) -> Array:
        along = xy[:, :1] * np.cos(self._heading) + xy[:, 1:] * np.sin(self._heading)
        return 2 * np.pi / self._length * along + self._phase


class Suspension:
    """How a rough road rolls and pitches a car: about a quarter of a degree, by distance driven.

    Besides being real, it keeps the rings on flat ground from looking the same in every sweep,
    which would hold point-to-point odometry in place.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._wavelength = rng.uniform(5.0, 25.0, (2, 5))
        self._phase = rng.uniform(0.0, 2 * np.pi, (2, 5))
        self._angle = np.radians(rng.uniform(0.08, 0.22, (2, 5)))

    def roll_pitch(self, travelled: Array) -> Array:
        """Return roll and pitch [N x 2] in radians after `travelled` [N] metres."""
        along = travelled[:, None, None]
        waves = self._angle * np.sin(2 * np.pi * along / self._wavelength + self._phase)
        return np.asarray(waves.sum(axis=-1))


class Town:
    """Grow houses, trees, cars, fences and lamps along streets."""

    def __init__(
        self, ground: Ground, centrelines: list[Array], driven_xy: Array, seed: int
    ) -> None:
        """Plan an empty town.

        Args:
            ground: the terrain it stands on.
            centrelines: waypoints [N x 2] of the streets.
            driven_xy: [M x 2] where the car will drive; nothing is put there.
            seed: of everything random.
        """
        self._ground = ground
        self._stretches = _unique_stretches(centrelines)
        self._streets = cKDTree(np.concatenate([_sampled(a, b) for a, b in self._stretches]))
        self._driven = cKDTree(driven_xy)
        self._rng = np.random.default_rng(seed)
        self._taken: list[tuple[Array, float, float, float]] = []
        self._circles: list[tuple[float, float, float]] = []  # around each of them: x, y, radius
        self._mesh = MeshBuilder()

    def build(self) -> Mesh:
        """Return the triangles of the town."""
        self._lay_ground()
        for a, b in self._stretches:
            direction = (b - a) / np.linalg.norm(b - a)
            a, b = a - 45.0 * direction, b + 45.0 * direction
            for side in (1.0, -1.0):
                self._line(a, b, side, 8.0, self._house, gap=(0.0, 8.0))
        for a, b in self._stretches:
            for side in (1.0, -1.0):
                self._line(a, b, side, 32.0, self._house, gap=(2.0, 25.0))
                self._line(a, b, side, KERB_M - 1.05, self._car, gap=(0.7, 15.0))
                self._line(a, b, side, KERB_M + 0.6, self._lamp, gap=(17.0, 31.0))
                self._line(a, b, side, KERB_M + 1.2, self._tree, gap=(3.0, 19.0))
                self._line(a, b, side, KERB_M + 2.0, self._fence, gap=(1.0, 10.0))
                self._line(a, b, side, KERB_M + 6.0, self._tree, gap=(4.0, 22.0))
        return self._mesh.build()

    def _line(
        self, a: Array, b: Array, side: float, away: float, place: Place, gap: tuple[float, float]
    ) -> None:
        """Put things beside a stretch; `place` returns how much of it each took."""
        length = float(np.linalg.norm(b - a))
        direction = (b - a) / length
        outward = side * np.array([-direction[1], direction[0]])
        yaw = float(np.arctan2(direction[1], direction[0]))
        s = float(self._rng.uniform(0.0, gap[1]))
        while s < length:
            s += place(a + s * direction + away * outward, direction, outward, yaw)
            s += float(self._rng.uniform(*gap))

    def _house(self, foot: Array, direction: Array, outward: Array, yaw: float) -> float:
        rng = self._rng
        width, depth = rng.uniform(7.0, 21.0), rng.uniform(7.0, 13.0)
        setback = rng.choice([0.5, 1.5, 4.0, 6.5])
        yaw += rng.normal(0.0, 0.02)
        centre = foot + (width / 2) * direction + (setback + depth / 2) * outward
        if self._claim(centre, width, depth, yaw, from_streets=7.5):
            facing = np.arctan2(-outward[1], -outward[0]) + np.pi / 2
            shapes.house(self._mesh, self._on_ground(centre), (width, depth), facing, rng)
        return float(width)

    def _car(self, foot: Array, direction: Array, outward: Array, yaw: float) -> float:
        rng = self._rng
        length, width = rng.uniform(3.6, 5.2), rng.uniform(1.65, 1.95)
        centre = foot + (length / 2) * direction + rng.normal(0.0, 0.08) * outward
        yaw += rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.03)
        if self._claim(centre, length, width, yaw, from_driven=1.7):
            shapes.car(self._mesh, self._on_ground(centre), (length, width), yaw, rng)
        return float(length)

    def _tree(self, foot: Array, direction: Array, outward: Array, yaw: float) -> float:
        centre = foot + self._rng.uniform(0.0, 1.5) * outward
        if self._claim(centre, 0.8, 0.8, yaw, from_streets=KERB_M + 0.3):
            shapes.tree(self._mesh, self._on_ground(centre), self._rng)
        return 1.0

    def _lamp(self, foot: Array, direction: Array, outward: Array, yaw: float) -> float:
        if self._claim(foot, 0.3, 0.3, yaw, from_streets=KERB_M):
            shapes.lamp(self._mesh, self._on_ground(foot), -outward, self._rng)
        return 0.3

    def _fence(self, foot: Array, direction: Array, outward: Array, yaw: float) -> float:
        length = float(self._rng.uniform(3.0, 12.0))
        centre = foot + (length / 2) * direction + self._rng.uniform(0.0, 1.0) * outward
        if self._claim(centre, length, 0.5, yaw, from_streets=KERB_M + 0.5):
            shapes.fence(self._mesh, self._on_ground(centre), length, yaw, self._rng)
        return length

    def _claim(
        self,
        centre: Array,
        length: float,
        width: float,
        yaw: float,
        *,
        from_streets: float = 0.0,
        from_driven: float = 2.0,
    ) -> bool:
        """Take a rectangle of ground if it is free, clear of the streets and of the driven path."""
        outline = _outline(centre, length, width, yaw)
        if self._streets.query(outline)[0].min() < from_streets:
            return False
        if self._driven.query(outline)[0].min() < from_driven:
            return False
        reach = 0.5 * float(np.hypot(length, width))
        x, y, reaches = np.array(self._circles).reshape(-1, 3).T
        for index in np.flatnonzero(np.hypot(x - centre[0], y - centre[1]) < reach + reaches):
            other = self._taken[index]
            if _inside(outline, *other) or _inside(_outline(*other), centre, length, width, yaw):
                return False
        self._taken.append((centre, length, width, yaw))
        self._circles.append((centre[0], centre[1], reach))
        return True

    def _on_ground(self, xy: Array) -> Array:
        return np.array([*xy, float(self._ground.height(xy[None])[0])])

    def _lay_ground(self) -> None:
        streets = np.concatenate([_sampled(a, b) for a, b in self._stretches])
        low, high = streets.min(0) - _REACH_M, streets.max(0) + _REACH_M
        x, y = (np.arange(low[i], high[i], _CELL_M) for i in (0, 1))
        xy = np.stack(np.meshgrid(x, y, indexing='ij'), axis=-1).reshape(-1, 2)
        away = self._streets.query(xy, distance_upper_bound=30.0)[0]
        # The road falls by 2.5 % from its crown to the gutter; behind it is a kerb of 12 cm.
        z = self._ground.height(xy) - 0.025 * np.minimum(away, KERB_M)
        beside = away > KERB_M
        z[beside] += 0.12 + self._rng.normal(0.0, 0.015, int(beside.sum()))
        index = np.arange(len(xy)).reshape(len(x), len(y))
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        triangles = np.concatenate(
            [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
        )
        vertices = np.column_stack([xy, z])
        green = (away[triangles] > KERB_M + 2.5).all(axis=1)
        self._mesh.label = Label.TERRAIN
        self._mesh.triangles(vertices, triangles[green], Material.GRASS)
        self._mesh.label = Label.ROAD
        self._mesh.triangles(vertices, triangles[~green], Material.ASPHALT)


def _unique_stretches(centrelines: list[Array]) -> list[tuple[Array, Array]]:
    """Return each street stretch once, in whichever direction it came first."""
    seen: dict[tuple[tuple[float, ...], ...], tuple[Array, Array]] = {}
    for line in centrelines:
        for a, b in pairwise(line):
            seen.setdefault(tuple(sorted((tuple(a), tuple(b)))), (a, b))
    return list(seen.values())


def _sampled(a: Array, b: Array) -> Array:
    return a + (b - a) * np.linspace(0.0, 1.0, int(np.linalg.norm(b - a) / 0.5) + 2)[:, None]


def _outline(centre: Array, length: float, width: float, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    along, across = np.array([c, s]) * length / 2, np.array([-s, c]) * width / 2
    corners = [centre + along + across, centre - along + across]
    corners += [centre - along - across, centre + along - across]
    edges = zip(corners, [*corners[1:], corners[0]], strict=True)
    return np.concatenate([[centre], *(_sampled(a, b) for a, b in edges)])


def _inside(points: Array, centre: Array, length: float, width: float, yaw: float) -> bool:
    c, s = np.cos(yaw), np.sin(yaw)
    local = (points - centre) @ np.array([[c, -s], [s, c]])
    return bool(np.any((np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 1]) < width / 2)))
