"""Grow a town from a seed, and change it from run to run as weeks change a real one."""

from functools import cached_property

import numpy as np

from bags.simulation.plots_of_land import Land
from bags.simulation.scene import Light, Mover, Scene
from bags.simulation.street_map import StreetEdge, street_map
from bags.simulation.streetscape import STREETSCAPES, Streetscape
from bags.simulation.traffic import traffic
from bags.street import shapes
from bags.street.mesh import Label, Material, Mesh, MeshBuilder, turn, up
from bags.street.town import Ground
from lcd_common import se3

_REACH_M = 60.0
_CELL_M = 1.0
_FINENESS, _BOUGHS = 3, 40  # of trees
_LEAVES = (1.0, 0.75, 0.45, 0.12)  # share on the trees: summer .. winter


class SimulatedTown:
    """A town of about 4 km of streets; the same seed is the same town to the last triangle.

    Seeds 0-99 are for training, 100-109 for validation, 200-209 for tests.
    """

    def __init__(self, seed: int, style: str | None = None, size: int = 6) -> None:
        """Plan a town; it is built when first looked at.

        Args:
            seed: of the town.
            style: one of STREETSCAPES for all streets, None for a mixture.
            size: crossings each way.
        """
        self.seed, self.style = seed, style
        self.streets = street_map(seed, style, size)
        self.ground = Ground(np.random.default_rng([seed, 12]))
        points = np.concatenate([edge.centreline for edge in self.streets.edges])
        halves = [np.full(len(e.centreline), e.half_width_m) for e in self.streets.edges]
        self._land = Land(points, np.concatenate(halves), self.streets.squares)
        self._points, self._half_m = points, np.concatenate(halves)

    def scene(self, run: int = 0) -> Scene:
        """Return the town during a run: other cars, leaves, light, traffic and building sites."""
        rng = np.random.default_rng([self.seed, 13, run])
        standing, leaves = self._standing
        cars = self._parked_cars(rng)
        share = float(_LEAVES[int(rng.integers(len(_LEAVES)))]) if run else 1.0
        # Leaves fall in the same order every time.
        order = np.random.default_rng([self.seed, 14]).random(len(leaves.triangles))
        kept = order < share
        hanging = Mesh(
            leaves.vertices, leaves.triangles[kept], leaves.materials[kept], leaves.labels[kept]
        )
        azimuth, height = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.35, 1.1)
        to_sun = [
            np.cos(azimuth) * np.cos(height),
            np.sin(azimuth) * np.cos(height),
            np.sin(height),
        ]
        light = Light(
            np.array(to_sun),
            sun=float(rng.choice([0.0, 0.5, 0.9])),
            ambient=float(rng.uniform(0.3, 0.5)),
            exposure=float(rng.uniform(0.8, 1.2)),
        )
        movers: tuple[Mover, ...] = traffic(self.streets, self.ground, rng)
        return Scene(_joined([standing, hanging, cars]), movers, light, self.seed)

    @cached_property
    def _standing(self) -> tuple[Mesh, Mesh]:
        """What stays from run to run, and the leaves of all trees."""
        mesh, leaves = MeshBuilder(), MeshBuilder()
        self._lay_ground(mesh)
        for rank, edge in enumerate(self.streets.edges):
            # A street of its own seed: its houses do not depend on what stands elsewhere.
            rng = np.random.default_rng([self.seed, 15, rank if edge.style != 'aliased' else 0])
            self._houses(mesh, edge, STREETSCAPES[edge.style], rng)
        for rank, edge in enumerate(self.streets.edges):
            rng = np.random.default_rng([self.seed, 16, rank if edge.style != 'aliased' else 0])
            self._furniture(mesh, leaves, edge, STREETSCAPES[edge.style], rng)
        return mesh.build(), leaves.build()

    def _houses(
        self, mesh: MeshBuilder, edge: StreetEdge, scape: Streetscape, rng: np.random.Generator
    ) -> None:
        if scape.house_gap is None:
            return
        for row in range(1 + scape.second_row):
            for side in (1.0, -1.0):
                like = scape.row(rng)
                s = float(rng.uniform(0.0, 4.0)) if edge.style != 'aliased' else 2.0
                while s < edge.length_m:
                    width, depth, setback = like.house(rng)
                    back = 2.0 + setback + 24.0 * row
                    foot, along, outward = _beside(edge, s + width / 2, side)
                    centre = foot + (edge.half_width_m + back + depth / 2) * outward
                    yaw = float(np.arctan2(along[1], along[0])) + rng.normal(0.0, 0.015)
                    seed = int(rng.integers(1 << 31)) if edge.style != 'aliased' else 5
                    if self._land.claim(centre, width, depth, yaw, 1.2):
                        facing = np.arctan2(-outward[1], -outward[0]) + np.pi / 2
                        at, own = self._on_ground(centre), np.random.default_rng(seed)
                        if scape.hall:
                            _hall(mesh, at, (width, depth), facing, own)
                        else:
                            storeys = int(
                                np.clip(like.storeys + own.integers(-1, 2), *scape.storeys)
                            )
                            shapes.house(mesh, at, (width, depth), facing, own, storeys)
                    s += width + float(rng.uniform(*scape.house_gap))

    def _furniture(
        self,
        mesh: MeshBuilder,
        leaves: MeshBuilder,
        edge: StreetEdge,
        scape: Streetscape,
        rng: np.random.Generator,
    ) -> None:
        half, aliased = edge.half_width_m, edge.style == 'aliased'
        for side in (1.0, -1.0):
            for s in _row(edge, scape.lamp_gap, rng):
                foot, _, outward = _beside(edge, s, side)
                at = foot + (half + 0.6) * outward
                if self._land.claim(at, 0.3, 0.3, 0.0, 0.2, on_squares=True):
                    own = np.random.default_rng(7 if aliased else int(rng.integers(1 << 31)))
                    shapes.lamp(mesh, self._on_ground(at), -outward, own)
            for away in (1.3, 6.5):
                for s in _row(edge, scape.tree_gap, rng):
                    foot, _, outward = _beside(edge, s, side)
                    at = foot + (half + away + (0.0 if aliased else rng.uniform(0, 1.5))) * outward
                    own = np.random.default_rng(8 if aliased else int(rng.integers(1 << 31)))
                    if self._land.claim(at, 0.8, 0.8, 0.0, 0.4):
                        shapes.tree(mesh, self._on_ground(at), own, leaves, _FINENESS, _BOUGHS)
            for away in (1.8, 3.0, 9.0, 16.0):
                for s in _row(edge, scape.shrub_gap, rng):
                    foot, _, outward = _beside(edge, s, side)
                    at = foot + (half + away + rng.uniform(-0.8, 3.0)) * outward
                    if self._land.claim(at, 0.8, 0.8, 0.0, 1.0):
                        shapes.shrub(mesh, self._on_ground(at), rng)
            self._borders(mesh, edge, scape, side, rng)

    def _borders(
        self,
        mesh: MeshBuilder,
        edge: StreetEdge,
        scape: Streetscape,
        side: float,
        rng: np.random.Generator,
    ) -> None:
        """Set the borders of the gardens along one side: mostly alike, in line, with gates."""
        if scape.hedge_gap is None:
            return
        usual, behind = shapes.border(rng), float(rng.uniform(1.8, 3.2))
        s = float(rng.uniform(0.0, scape.hedge_gap[1]))
        while s < edge.length_m:
            length = float(rng.uniform(6.0, 18.0))
            kind = usual if rng.random() < 0.7 else shapes.border(rng)
            for part in (length, 0.4 * length):  # something stands in the way: a shorter one
                foot, along, outward = _beside(edge, s + part / 2, side)
                at = foot + (edge.half_width_m + behind) * outward
                yaw = float(np.arctan2(along[1], along[0]))
                if self._land.claim(at, part, 0.5, yaw, 0.8):
                    shapes.fence(mesh, self._on_ground(at), part, yaw, rng, kind)
                    break
            s += part + float(rng.uniform(*scape.hedge_gap))

    def _parked_cars(self, rng: np.random.Generator) -> Mesh:
        """Park cars of this run, and set up a building site or two."""
        mesh = MeshBuilder()
        for edge in self.streets.edges:
            gap = STREETSCAPES[edge.style].car_gap
            if edge.half_width_m < 4.0 or gap is None:  # too narrow to park on both sides
                continue
            full = rng.uniform(0.3, 1.0)
            for side in (1.0, -1.0):
                for s in _row(edge, gap, rng, length=4.5):
                    if 8.0 < s < edge.length_m - 12.0 and rng.random() < full:
                        self._park(mesh, edge, s, side, rng)
        for edge in rng.choice(np.array(self.streets.edges, object), 3):
            foot, along, outward = _beside(edge, edge.length_m * rng.uniform(0.3, 0.7), 1.0)
            at = self._on_ground(foot + (edge.half_width_m + 1.2) * outward)
            yaw = float(np.arctan2(along[1], along[0]))
            mesh.label = Label.FENCE
            mesh.box(at + up(0.6), (float(rng.uniform(4, 14)), 0.05, 1.2), yaw, Material.METAL)
            mesh.label = Label.UNLABELED
            mesh.box(at + up(1.2), (2.4, 1.1, 2.4), yaw, Material.METAL)
        return mesh.build()

    def _park(
        self, mesh: MeshBuilder, edge: StreetEdge, s: float, side: float, rng: np.random.Generator
    ) -> None:
        length, width = rng.uniform(3.6, 5.2), rng.uniform(1.65, 1.95)
        foot, along, outward = _beside(edge, s + length / 2, side)
        at = foot + (edge.half_width_m - width / 2 - rng.uniform(0.05, 0.3)) * outward
        yaw = float(np.arctan2(along[1], along[0])) + rng.choice([0.0, np.pi])
        yaw += rng.normal(0.0, 0.02)
        # Streets that meet at an acute angle overlap: nobody parks in the way of the other one.
        within = np.linalg.norm(self._points - at, axis=1) < self._half_m + 0.9
        own = np.linalg.norm(edge.centreline[:, None] - self._points[within], axis=2).min(axis=0)
        if (own < 1e-6).all():
            shapes.car(mesh, self._on_ground(at), (length, width), yaw, rng)

    def _on_ground(self, xy: se3.Array) -> se3.Array:
        return np.array([*xy, float(self.ground.height(xy[None])[0])])

    def _lay_ground(self, mesh: MeshBuilder) -> None:
        low, high = self._points.min(0) - _REACH_M, self._points.max(0) + _REACH_M
        x, y = (np.arange(low[i], high[i], _CELL_M) for i in (0, 1))
        xy = np.stack(np.meshgrid(x, y, indexing='ij'), axis=-1).reshape(-1, 2)
        behind = self._land.from_kerb_m(xy)
        # The road falls by 2.5 % from its crown to the gutter; behind it is a kerb of 12 cm.
        rng = np.random.default_rng([self.seed, 17])
        z = self.ground.height(xy) + np.where(behind < 0.0, -0.025 * (behind + 5.0), 0.0)
        z[behind > 0.0] += 0.06
        z[behind > 2.0] += rng.normal(0.0, 0.02, int((behind > 2.0).sum()))
        index = np.arange(len(xy)).reshape(len(x), len(y))
        a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
        triangles = np.concatenate(
            [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
        )
        nearest, farthest = behind[triangles].min(axis=1), behind[triangles].max(axis=1)
        triangles = triangles[nearest < _REACH_M]
        farthest = farthest[nearest < _REACH_M]
        on_square = self._land.on_square(xy[triangles].mean(axis=1))
        paved = (farthest <= 2.5) | (on_square & (farthest > 0.5))
        vertices = np.column_stack([xy, z])
        for label, material, inside in (
            (Label.ROAD, Material.ASPHALT, farthest <= 0.5),
            (Label.SIDEWALK, Material.ASPHALT, (farthest > 0.5) & paved),
            (Label.TERRAIN, Material.GRASS, ~paved),
        ):
            mesh.label = label
            mesh.triangles(vertices, triangles[inside], material)


def _beside(edge: StreetEdge, s: float, side: float) -> tuple[se3.Array, se3.Array, se3.Array]:
    """Return the centreline's point at `s` metres, and unit vectors along and away from it."""
    point, along = edge.at(s)
    return point, along, side * np.array([-along[1], along[0]])


def _row(
    edge: StreetEdge, gap: tuple[float, float] | None, rng: np.random.Generator, length: float = 0.5
) -> list[float]:
    """Return places along a street."""
    if gap is None:
        return []
    places, s = [], float(rng.uniform(0.0, gap[1])) if gap[0] < gap[1] else 3.0
    while s < edge.length_m:
        places.append(s)
        s += length + float(rng.uniform(*gap))
    return places


def _hall(
    mesh: MeshBuilder,
    foot: se3.Array,
    size: tuple[float, float],
    yaw: float,
    rng: np.random.Generator,
) -> None:
    """Add a hall with ribs on its walls, gates and a flat roof."""
    mesh.label = Label.BUILDING
    width, depth = size
    height = float(rng.uniform(4.0, 9.0))
    material = Material(rng.choice([Material.METAL, Material.PLASTER, Material.BRICK]))
    mesh.box(foot + up(height / 2 - 0.5), (width, depth, height + 1.0), yaw, material)
    R = turn(yaw)
    for x in np.arange(-width / 2, width / 2 + 0.1, float(rng.uniform(3.0, 6.0))):
        rib = foot + R @ [x, -depth / 2 - 0.12, 0.0] + up(height / 2)
        mesh.box(rib, (0.35, 0.25, height), yaw, Material.PLASTER)
    for _ in range(int(rng.integers(1, 4))):
        x, tall = rng.uniform(-0.4, 0.4) * width, float(rng.uniform(2.6, 4.0))
        ramp = foot + R @ [x, -depth / 2 - 0.3, 0.0] + up(tall / 2)
        mesh.box(ramp, (3.2, 0.6, tall), yaw, Material.METAL)


def _joined(meshes: list[Mesh]) -> Mesh:
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(
            [mesh.triangles + np.uint32(k) for mesh, k in zip(meshes, first, strict=True)]
        ),
        np.concatenate([mesh.materials for mesh in meshes]),
        np.concatenate([mesh.labels for mesh in meshes]),
    )
