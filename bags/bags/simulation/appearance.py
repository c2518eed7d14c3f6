"""Say how each triangle of a mesh looks to a camera: what it is, its colour, its window's frame."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bags.street.mesh import Label, Material, Mesh

Floats = NDArray[np.float32]


class Kind(IntEnum):
    """The textures there are; SKY is where nothing is."""

    SKY = 0
    ROAD = 1
    PAVING = 2
    GRASS = 3
    PLASTER = 4
    BRICK = 5
    ROOF = 6
    WINDOW = 7
    PAINT = 8
    CAR_GLASS = 9
    LEAF = 10
    BARK = 11
    WOOD = 12
    PLAIN = 13


_OF_MATERIAL = {
    Material.ASPHALT: Kind.ROAD,
    Material.GRASS: Kind.GRASS,
    Material.PLASTER: Kind.PLASTER,
    Material.BRICK: Kind.BRICK,
    Material.GLASS: Kind.WINDOW,
    Material.METAL: Kind.PLAIN,
    Material.LEAF: Kind.LEAF,
    Material.BARK: Kind.BARK,
    Material.WOOD: Kind.WOOD,
}
_VEHICLES = (Label.CAR, Label.TRUCK, Label.MOVING_CAR)
_PEOPLE = (Label.PERSON, Label.MOVING_PERSON, Label.BICYCLE)
# Linear reflectance (not sRGB) in red, green, blue; one of a palette is drawn for each object.
_PALETTES = {
    Kind.ROAD: [(0.125, 0.124, 0.123)],
    Kind.PAVING: [(0.21, 0.205, 0.195)],
    Kind.GRASS: [(0.070, 0.090, 0.032)],
    Kind.PLASTER: [
        (0.62, 0.58, 0.50), (0.66, 0.64, 0.60), (0.58, 0.48, 0.30), (0.50, 0.47, 0.43),
        (0.60, 0.50, 0.42), (0.42, 0.40, 0.37), (0.52, 0.55, 0.48), (0.70, 0.66, 0.55),
    ],
    Kind.BRICK: [
        (0.26, 0.105, 0.065), (0.22, 0.12, 0.080), (0.34, 0.22, 0.14), (0.30, 0.28, 0.25),
    ],
    Kind.ROOF: [(0.22, 0.085, 0.050), (0.16, 0.075, 0.055), (0.075, 0.072, 0.075)],
    Kind.WINDOW: [(0.035, 0.038, 0.042)],
    Kind.PAINT: [
        (0.020, 0.020, 0.022), (0.32, 0.33, 0.34), (0.13, 0.14, 0.15), (0.62, 0.62, 0.62),
        (0.050, 0.055, 0.062), (0.025, 0.050, 0.16), (0.24, 0.020, 0.018), (0.05, 0.09, 0.07),
    ],
    Kind.CAR_GLASS: [(0.014, 0.016, 0.018)],
    Kind.LEAF: [(0.085, 0.120, 0.034), (0.065, 0.100, 0.036), (0.110, 0.130, 0.040)],
    Kind.BARK: [(0.085, 0.070, 0.055)],
    Kind.WOOD: [(0.20, 0.13, 0.075), (0.28, 0.26, 0.22), (0.10, 0.075, 0.050)],
    Kind.PLAIN: [(0.20, 0.21, 0.21)],
}  # fmt: skip
_TYRE = (0.016, 0.016, 0.017)
_SIGNS = np.array(
    [(0.60, 0.60, 0.58), (0.035, 0.09, 0.36), (0.50, 0.035, 0.03), (0.62, 0.42, 0.03)]
)
_CLOTHES = np.array(
    [
        (0.03, 0.04, 0.09),
        (0.30, 0.30, 0.30),
        (0.22, 0.04, 0.04),
        (0.05, 0.05, 0.05),
        (0.1, 0.2, 0.1),
    ]
)
_BELOW_ONE = np.nextafter(np.float32(1.0), np.float32(0.0))


@dataclass(frozen=True)
class Appearance:
    """How triangles look.

    Attributes:
        kind: [T] of Kind.
        tint: [T x 3] reflectance in red, green, blue, linear 0..1.
        extent: [T x 4] least and greatest u and v (see `plane_axes`) of the object that the
            triangle is part of; 0 for kinds that have no edges.
        pick: [T] a random number in 0..1 of that object.
    """

    kind: NDArray[np.uint8]
    tint: Floats
    extent: Floats
    pick: Floats

    @classmethod
    def joined(cls, parts: list['Appearance']) -> 'Appearance':
        """Put the surfaces of several meshes behind each other."""
        return cls(
            np.concatenate([part.kind for part in parts]),
            np.concatenate([part.tint for part in parts]),
            np.concatenate([part.extent for part in parts]),
            np.concatenate([part.pick for part in parts]),
        )


def plane_axes(normal: Floats) -> tuple[Floats, Floats]:
    """Return the axes u, v [3 x N] in which triangles with these normals [3 x N] are textured.

    On walls and roofs u runs level and v up along the surface; on the ground they are x and y. The
    sign of the normal does not matter.
    """
    x, y, z = normal
    level = np.sqrt(x * x + y * y)
    flat = level < 0.3
    # Either normal of a wall gives the same axis: it is turned to one side.
    side = np.where(x + np.float32(0.37) * y < 0, np.float32(-1.0), np.float32(1.0))
    scale = np.where(flat, np.float32(0.0), side / np.maximum(level, np.float32(0.3)))
    size = np.abs(scale)
    u = np.stack([flat - y * scale, x * scale, np.zeros_like(x)])
    v = np.stack([-z * x * size, flat - z * y * size, level * ~flat])  # normal x u, upwards
    return u, v


def appearance_of(mesh: Mesh, seed: int, *, one_object: bool = False) -> Appearance:
    """Choose how a mesh looks: by material and label, and at random by where an object stands.

    Args:
        mesh: world frame.
        seed: of the random choices.
        one_object: the mesh is a single thing (a moving car): one colour for all of its paint.
    """
    corners = mesh.vertices[mesh.triangles]
    kind = _kinds(mesh, corners)
    tint, extent = np.zeros((len(kind), 3), np.float32), np.zeros((len(kind), 4), np.float32)
    pick = np.zeros(len(kind), np.float32)
    for each in np.unique(kind):
        of = np.flatnonzero(kind == each)
        if each in (Kind.ROAD, Kind.PAVING, Kind.GRASS):
            tint[of] = _PALETTES[Kind(each)][0]
            continue
        member = np.arange(len(of)) if each == Kind.LEAF else _objects(mesh, of)
        middle = _middles(corners[of], member)
        if each == Kind.PAINT:
            member = np.zeros(len(of), int) if one_object else _joined(middle)[member]
            middle = _middles(corners[of], member)
        # Below 1, but single precision may round it to 1.
        pick[of] = np.minimum(position_hash(middle, seed + int(each))[member], _BELOW_ONE)
        palette = np.array(_PALETTES[Kind(each)])
        chosen = palette[(pick[of] * len(palette)).astype(int)]
        shade = 0.85 + 0.3 * position_hash(middle, seed + 100)[member]
        tint[of] = chosen * shade[:, None]
        if each == Kind.WINDOW:
            extent[of] = _extents(corners[of], member)
    _special_tints(mesh, kind, pick, tint)
    return Appearance(kind, tint, extent, pick)


def position_hash(xyz: NDArray[np.floating], seed: int) -> NDArray[np.float64]:
    """Return a random number in 0..1 for each position [N x 3], the same within about 0.2 m."""
    cell = np.floor(np.asarray(xyz, float) * 5.0 + 0.31).astype(np.int64).view(np.uint64)
    mixed = np.full(len(cell), (seed * 0x9E3779B97F4A7C15) % 2**64, np.uint64)
    for axis in range(3):
        mixed ^= cell[:, axis] * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(27)
    return (mixed >> np.uint64(11)).astype(float) / 2.0**53


def _kinds(mesh: Mesh, corners: Floats) -> NDArray[np.uint8]:
    of_material = np.full(256, Kind.PLAIN, np.uint8)
    for material, as_kind in _OF_MATERIAL.items():
        of_material[material] = as_kind
    kind = of_material[mesh.materials]
    label = mesh.labels
    vehicle = np.isin(label, _VEHICLES)
    kind[vehicle & (kind == Kind.WINDOW)] = Kind.CAR_GLASS
    kind[vehicle & (mesh.materials == Material.METAL)] = Kind.PAINT
    kind[(vehicle | np.isin(label, _PEOPLE)) & (kind == Kind.ROAD)] = Kind.PLAIN  # tyres
    kind[np.isin(label, _PEOPLE)] = Kind.PLAIN
    kind[(label == Label.SIDEWALK) & (kind == Kind.ROAD)] = Kind.PAVING
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sloped = np.abs(normal[:, 2]) > 0.15 * np.linalg.norm(normal, axis=1)
    kind[(label == Label.BUILDING) & np.isin(kind, (Kind.BRICK, Kind.PLASTER)) & sloped] = Kind.ROOF
    return kind


def _special_tints(mesh: Mesh, kind: NDArray[np.uint8], pick: Floats, tint: Floats) -> None:
    """Colour what is plain: tyres black, signs and clothes from palettes of their own."""
    plain = kind == Kind.PLAIN
    sign = plain & (mesh.labels == Label.TRAFFIC_SIGN)
    tint[sign] = _SIGNS[(pick[sign] * len(_SIGNS)).astype(int)]
    person = plain & np.isin(mesh.labels, _PEOPLE)
    tint[person] = _CLOTHES[(pick[person] * len(_CLOTHES)).astype(int)]
    tint[plain & np.isin(mesh.labels, _VEHICLES)] = _TYRE


def _objects(mesh: Mesh, of: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return which object each of these triangles is part of: those that touch at a corner."""
    used = mesh.triangles[of].ravel()
    cell = np.round(mesh.vertices[used] * 50.0).astype(np.int64) + 2**20  # 2 cm
    key = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    corner = np.unique(key, return_inverse=True)[1].reshape(-1, 3)
    number = int(corner.max()) + 1
    i, j = np.r_[corner[:, 0], corner[:, 1]], np.r_[corner[:, 1], corner[:, 2]]
    graph = coo_matrix((np.ones(len(i), np.int8), (i, j)), (number, number))
    piece = connected_components(graph, directed=False)[1][corner[:, 0]]
    return np.unique(piece, return_inverse=True)[1]


def _middles(corners: Floats, member: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the middle [M x 3] of the box around each object."""
    number = int(member.max()) + 1
    low, high = np.full((number, 3), np.inf), np.full((number, 3), -np.inf)
    np.minimum.at(low, member, corners.min(axis=1))
    np.maximum.at(high, member, corners.max(axis=1))
    return (low + high) / 2


def _joined(middle: NDArray[np.float64], within_m: float = 1.2) -> NDArray[np.int64]:
    """Return new numbers [M] of objects: body and roof of a car stand above each other."""
    pairs = cKDTree(middle[:, :2]).query_pairs(within_m, output_type='ndarray')
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(middle), len(middle)))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _extents(corners: Floats, member: NDArray[np.int64]) -> Floats:
    """Return the least and greatest u and v of the object of each triangle [T x 4]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    number = int(member.max()) + 1
    out = np.empty((len(member), 4), np.float32)
    for column, axis in zip((0, 2), plane_axes(normal.T), strict=True):
        along = np.einsum('tcj,jt->tc', corners, axis)
        low, high = np.full(number, np.inf), np.full(number, -np.inf)
        np.minimum.at(low, member, along.min(axis=1))
        np.maximum.at(high, member, along.max(axis=1))
        out[:, column], out[:, column + 1] = low[member], high[member]
    return out
