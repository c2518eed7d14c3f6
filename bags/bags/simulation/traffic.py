"""Cars that drive and people who walk through a town."""

import numpy as np

from bags.simulation.scene import Mover
from bags.simulation.street_map import StreetEdge, StreetMap
from bags.street import shapes
from bags.street.mesh import Label, Material, Mesh, MeshBuilder
from bags.street.town import Ground
from lcd_common import se3

_PERIOD_S = 600.0  # a mover comes within so long after the drive's start
_PER_KM = 30.0  # movers that come within that time


def traffic(streets: StreetMap, ground: Ground, rng: np.random.Generator) -> tuple[Mover, ...]:
    """Return movers that each go along one street at some time within the first ten minutes."""
    movers = []
    weights = np.array([edge.length_m for edge in streets.edges])
    for _ in range(int(_PER_KM * weights.sum() / 1000.0)):
        edge = streets.edges[int(rng.choice(len(weights), p=weights / weights.sum()))]
        walks = rng.random() < 0.4
        mesh = _person(rng) if walks else _car(rng)
        speed = rng.uniform(0.9, 1.7) if walks else rng.uniform(5.0, 12.0)
        away = edge.half_width_m + 1.0 if walks else edge.half_width_m * 0.4
        movers.append(_along(mesh, edge, ground, away, speed, rng))
    return tuple(movers)


def _along(
    mesh: Mesh,
    edge: StreetEdge,
    ground: Ground,
    away_m: float,
    speed: float,
    rng: np.random.Generator,
) -> Mover:
    line = edge.centreline if rng.random() < 0.5 else edge.centreline[::-1]
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    xy = line + away_m * np.column_stack([along[:, 1], -along[:, 0]])  # on the right
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    time_s = rng.uniform(0.0, _PERIOD_S) + np.concatenate([[0.0], np.cumsum(steps)]) / speed
    yaw = np.arctan2(along[:, 1], along[:, 0])
    T = np.array([se3.rotation_z(float(angle)) for angle in yaw])
    T[:, :2, 3], T[:, 2, 3] = xy, ground.height(xy)
    return Mover(mesh, time_s, T)


def _car(rng: np.random.Generator) -> Mesh:
    mesh = MeshBuilder()
    size = float(rng.uniform(3.6, 5.2)), float(rng.uniform(1.65, 1.95))
    shapes.car(mesh, np.zeros(3), size, 0.0, rng)
    return mesh.build()


def _person(rng: np.random.Generator) -> Mesh:
    mesh = MeshBuilder()
    mesh.label = Label.PERSON
    tall = float(rng.uniform(1.5, 1.9))
    for side in (-0.12, 0.12):
        mesh.prism(np.array([0.0, side, 0.0]), 0.48 * tall, 0.08, Material.PLASTER)
    mesh.prism(np.array([0.0, 0.0, 0.45 * tall]), 0.4 * tall, 0.2, Material.PLASTER)
    mesh.prism(np.array([0.0, 0.0, 0.86 * tall]), 0.14 * tall, 0.1, Material.PLASTER)
    return mesh.build()
