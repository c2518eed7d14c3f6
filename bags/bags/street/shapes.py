"""Model what stands in a street: houses with windows, cars, trees, fences, lamps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.street.mesh import Label, Material, MeshBuilder, turn, up

Array = NDArray[np.float64]
Quad = list[list[float]]
_BORDERS = ('wall', 'hedge', 'pickets')


def house(
    mesh: MeshBuilder,
    foot: Array,
    size: tuple[float, float],
    yaw: float,
    rng: np.random.Generator,
    storeys: int | None = None,
) -> None:
    """Add a house with recessed windows, a roof and, now and then, a bay or a balcony."""
    mesh.label = Label.BUILDING
    width, depth = size
    storeys = int(rng.integers(1, 5)) if storeys is None else storeys
    height = 0.8 + storeys * rng.uniform(2.7, 3.3)
    material = Material(rng.choice([Material.PLASTER, Material.BRICK]))
    base = foot - up(1.0)  # the ground may fall along the wall
    R = turn(yaw)
    period, window = rng.uniform(2.2, 4.0), rng.uniform(0.9, 1.6)
    recess = rng.uniform(0.12, 0.35)
    for quarter, (run, out) in enumerate([(width, depth), (depth, width)] * 2):
        R_side = R @ turn(quarter * np.pi / 2)
        facade = _facade(run, height + 1.0, storeys, period, window, recess, rng)
        for corners, kind in zip(facade, (material, Material.GLASS), strict=True):
            if len(corners):
                mesh.quads((corners + np.array([0.0, -out / 2, 0.0])) @ R_side.T + base, kind)
    _roof(mesh, base + up(height + 1.0), R, size, rng)
    if rng.random() < 0.5:  # a bay, a porch or a balcony towards the street
        sides = (float(rng.uniform(1.5, 3.5)), float(rng.uniform(0.6, 1.6)))
        lift = float(rng.choice([0.0, 2.9])) if storeys > 1 else 0.0
        tall = float(rng.uniform(1.1, 3.0))
        along = rng.uniform(-0.3, 0.3) * width
        centre = R @ [along, -depth / 2 - sides[1] / 2, 0.0] + foot + up(lift + tall / 2)
        mesh.box(centre, (sides[0], sides[1], tall), yaw, material)


def _facade(
    run: float,
    height: float,
    storeys: int,
    period: float,
    window: float,
    recess: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return wall and window quads [Q x 4 x 3] of a wall along x at y = 0, inside at y > 0."""
    columns = max(1, int(run / period))
    mid_x = (np.arange(columns) + 0.5) * run / columns - run / 2
    x = np.sort(np.concatenate([[-run / 2, run / 2], mid_x - window / 2, mid_x + window / 2]))
    storey = (height - 1.0) / storeys
    sill = 1.0 + storey * np.arange(storeys) + rng.uniform(0.8, 1.1)
    z = np.sort(np.concatenate([[0.0, height], sill, sill + min(1.5, 0.5 * storey)]))
    glass = np.zeros((len(x) - 1, len(z) - 1), bool)
    glass[1::2, 1::2] = rng.random((columns, storeys)) > 0.15  # some are walled up
    y = np.where(glass, recess, 0.0)
    walls: list[Quad] = []
    windows: list[Quad] = []
    for i in range(len(x) - 1):
        for j in range(len(z) - 1):
            (windows if glass[i, j] else walls).append(
                _upright(x[i : i + 2], z[j : j + 2], y[i, j])
            )
            if glass[i, j]:
                walls += _reveal(x[i : i + 2], z[j : j + 2], recess)
    return np.array(walls).reshape(-1, 4, 3), np.array(windows).reshape(-1, 4, 3)


def _upright(x: Array, z: Array, y: float) -> Quad:
    return [[x[0], y, z[0]], [x[1], y, z[0]], [x[1], y, z[1]], [x[0], y, z[1]]]


def _reveal(x: Array, z: Array, depth: float) -> list[Quad]:
    """Return the four narrow sides of a recess."""
    sides = [
        [[x[k], 0, z[0]], [x[k], 0, z[1]], [x[k], depth, z[1]], [x[k], depth, z[0]]] for k in (0, 1)
    ]
    return sides + [
        [[x[0], 0, z[k]], [x[1], 0, z[k]], [x[1], depth, z[k]], [x[0], depth, z[k]]] for k in (0, 1)
    ]


def _roof(
    mesh: MeshBuilder, top: Array, R: Array, size: tuple[float, float], rng: np.random.Generator
) -> None:
    w, d = size[0] / 2, size[1] / 2
    ridge = rng.uniform(0.3, 4.0)
    quads = np.array(
        [
            [[-w, -d, 0], [w, -d, 0], [w, 0, ridge], [-w, 0, ridge]],
            [[w, d, 0], [-w, d, 0], [-w, 0, ridge], [w, 0, ridge]],
            [[-w, -d, 0], [-w, 0, ridge], [-w, d, 0], [-w, -d, 0]],
            [[w, d, 0], [w, 0, ridge], [w, -d, 0], [w, d, 0]],
        ]
    )
    mesh.quads(quads @ R.T + top, Material.BRICK)


def car(
    mesh: MeshBuilder, foot: Array, size: tuple[float, float], yaw: float, rng: np.random.Generator
) -> None:
    """Add a parked car: body, cabin, wheels."""
    mesh.label = Label.CAR
    length, width = size
    sill, belt = rng.uniform(0.18, 0.35), rng.uniform(0.55, 0.75)
    roof = rng.uniform(0.45, 0.65) if rng.random() < 0.85 else rng.uniform(0.9, 1.3)
    R = turn(yaw)
    body = foot + up(sill + belt / 2)
    mesh.box(body, (length, width, belt), yaw, Material.METAL)
    cabin = rng.uniform(0.4, 0.62) * length
    shift = R @ [rng.uniform(-0.15, 0.05) * length, 0.0, 0.0]
    centre = foot + shift + up(sill + belt + roof / 2)
    mesh.box(centre, (cabin, 0.86 * width, roof - 0.06), yaw, Material.GLASS)
    lid = foot + shift + up(sill + belt + roof)
    mesh.box(lid, (0.9 * cabin, 0.88 * width, 0.08), yaw, Material.METAL)
    for x in (-0.32, 0.32):
        for y in (-0.42, 0.42):
            wheel = foot + R @ [x * length, y * width, 0.3]
            mesh.box(wheel, (0.6, 0.2, 0.6), yaw, Material.ASPHALT)


def tree(
    mesh: MeshBuilder,
    foot: Array,
    rng: np.random.Generator,
    leaves_mesh: MeshBuilder | None = None,
    fineness: int = 1,
    boughs: int = 0,
) -> None:
    """Add a tree: a trunk, and leaves as loose triangles in an ellipsoid or a cone.

    The leaves go into a mesh of their own where one is given; there are `fineness` times as many,
    and as much smaller. Boughs are large triangles of leaves inside the crown: the more there are,
    the less is seen through it.
    """
    height = rng.uniform(3.5, 11.0)
    trunk = rng.uniform(0.2, 0.45) * height
    mesh.label = Label.TRUNK
    mesh.prism(foot - up(0.3), trunk + 1.0, rng.uniform(0.08, 0.28), Material.BARK)
    mesh.label = Label.VEGETATION
    radius = rng.uniform(0.9, 2.6)
    count = fineness * int(rng.integers(90, 220))
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    at = direction * np.cbrt(rng.uniform(0.2, 1.0, (count, 1)))
    if rng.random() < 0.3:  # a conifer
        at[:, :2] *= 0.5 * (1.0 - at[:, 2:])
    crown = at * [radius, radius, (height - trunk) / 2] + up((height + trunk) / 2)
    size = np.full(count, 0.22 / np.sqrt(fineness))
    size[:boughs] = 0.45
    crown[:boughs] += 0.25 * (up((height + trunk) / 2) - crown[:boughs])
    leaves = crown[:, None] + rng.normal(0.0, 1.0, (count, 3, 3)) * size[:, None, None] + foot
    mesh = leaves_mesh or mesh
    mesh.label = Label.VEGETATION
    mesh.triangles(leaves.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.LEAF)


def shrub(mesh: MeshBuilder, foot: Array, rng: np.random.Generator) -> None:
    """Add a shrub, a few of them grown together, or a heap of whatever stands in gardens."""
    mesh.label = Label.VEGETATION
    radius, height = float(rng.uniform(0.4, 1.6)), float(rng.uniform(0.4, 2.4))
    count = int(60 * radius * height) + 20
    at = rng.normal(0.0, 0.5, (count, 3)) * [radius, radius, 0.6 * height] + up(0.5 * height)
    leaves = at[:, None] + rng.normal(0.0, 0.12, (count, 3, 3)) + foot
    leaves[..., 2] = np.maximum(leaves[..., 2], foot[2] - 0.1)
    mesh.triangles(leaves.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.LEAF)


def lamp(mesh: MeshBuilder, foot: Array, inward: Array, rng: np.random.Generator) -> None:
    """Add a street lamp or the post of a traffic sign."""
    if rng.random() < 0.4:
        height = rng.uniform(2.0, 2.8)
        mesh.label = Label.POLE
        mesh.prism(foot, height, 0.04, Material.METAL)
        mesh.label = Label.TRAFFIC_SIGN
        yaw = float(rng.uniform(0, np.pi))
        mesh.box(foot + up(height), (0.6, 0.03, rng.uniform(0.3, 0.8)), yaw, Material.METAL)
        return
    mesh.label = Label.POLE
    height = rng.uniform(4.5, 8.0)
    mesh.prism(foot, height, rng.uniform(0.06, 0.11), Material.METAL)
    yaw = float(np.arctan2(inward[1], inward[0]))
    arm = foot + np.array([*(0.7 * inward), height])
    mesh.box(arm, (1.5, 0.15, 0.1), yaw, Material.METAL)


@dataclass(frozen=True)
class Border:
    """A kind of garden border: 'wall', 'hedge' or 'pickets', and its height in metres.

    Nobody sees through a `dense` hedge.
    """

    kind: str
    height_m: float
    dense: bool = False


def border(rng: np.random.Generator) -> Border:
    """Draw a kind of border; walls and hedges may be taller than a person."""
    kind = str(rng.choice(_BORDERS, p=[0.4, 0.4, 0.2]))
    return Border(kind, float(rng.uniform(0.8, 1.4 if kind == 'pickets' else 2.3)), dense=True)


def fence(
    mesh: MeshBuilder,
    foot: Array,
    length: float,
    yaw: float,
    rng: np.random.Generator,
    of: Border | None = None,
) -> None:
    """Add a garden border of a kind, or of any."""
    of = of or Border(_BORDERS[int(rng.integers(3))], float(rng.uniform(0.7, 1.6)))
    height, R = of.height_m, turn(yaw)
    mesh.label = Label.FENCE
    if of.kind == 'wall':
        thick = float(rng.uniform(0.15, 0.35))
        mesh.box(foot + up(height / 2 - 0.2), (length, thick, height + 0.4), yaw, Material.BRICK)
    elif of.kind == 'hedge':
        mesh.label = Label.VEGETATION
        if of.dense:
            core = (length - 0.2, 0.4, height - 0.1)
            mesh.box(foot + up(core[2] / 2 - 0.2), core, yaw, Material.LEAF)
        count = int(30 * length)
        at = rng.uniform([-length / 2, -0.4, 0.0], [length / 2, 0.4, height], (count, 3)) @ R.T
        leaves = at[:, None] + rng.normal(0.0, 0.12, (count, 3, 3)) + foot
        mesh.triangles(leaves.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), Material.LEAF)
    else:
        for x in np.arange(-length / 2, length / 2, float(rng.uniform(0.2, 0.5))):
            post = foot + R @ [x, 0.0, height / 2]
            mesh.box(post, (0.09, 0.03, height), yaw, Material.WOOD)
        mesh.box(foot + up(0.8 * height), (length, 0.05, 0.1), yaw, Material.WOOD)
