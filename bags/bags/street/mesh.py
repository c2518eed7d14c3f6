"""Collect triangles with materials."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]


class Material(IntEnum):
    """What a surface is made of; index into REFLECTIVITY and RETURN_SHARE."""

    ASPHALT = 0
    GRASS = 1
    PLASTER = 2
    BRICK = 3
    GLASS = 4
    METAL = 5
    LEAF = 6
    BARK = 7
    WOOD = 8


class Label(IntEnum):
    """What a surface belongs to, by SemanticKITTI's numbers."""

    UNLABELED = 0
    CAR = 10
    BICYCLE = 11
    TRUCK = 18
    PERSON = 30
    ROAD = 40
    PARKING = 44
    SIDEWALK = 48
    BUILDING = 50
    FENCE = 51
    VEGETATION = 70
    TRUNK = 71
    TERRAIN = 72
    POLE = 80
    TRAFFIC_SIGN = 81
    MOVING_CAR = 252
    MOVING_PERSON = 254


# MOVING[label]: what a thing is called that moves on its own.
MOVING = np.arange(256, dtype=np.uint8)
MOVING[[Label.CAR, Label.PERSON]] = Label.MOVING_CAR, Label.MOVING_PERSON
# Share of near-infrared light sent back, in the order of Material: plausible, not measured.
REFLECTIVITY = np.array([0.15, 0.40, 0.60, 0.35, 0.10, 0.70, 0.45, 0.25, 0.50])
# Share of the rays that come back at all; glass is mostly looked through.
RETURN_SHARE = np.array([0.98, 0.98, 0.99, 0.99, 0.35, 0.95, 0.95, 0.98, 0.98])

_BOX_CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_BOX_QUADS = np.array(
    [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
)


@dataclass(frozen=True)
class Mesh:
    """Triangles of a scene: vertices [V x 3] m, triangles [T x 3], materials and labels [T]."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    materials: NDArray[np.uint8]
    labels: NDArray[np.uint8]


class MeshBuilder:
    """Gather shapes and join them once; `label` is that of the shapes to come."""

    def __init__(self) -> None:
        self.label = Label.UNLABELED
        self._labels: list[NDArray[np.uint8]] = []
        self._vertices: list[Vertices] = []
        self._triangles: list[NDArray[np.int64]] = []
        self._materials: list[NDArray[np.uint8]] = []
        self._count = 0

    def triangles(
        self, vertices: Vertices, triangles: NDArray[np.int64], material: Material
    ) -> None:
        """Add triangles over vertices [V x 3]."""
        self._vertices.append(vertices)
        self._triangles.append(triangles + self._count)
        self._materials.append(np.full(len(triangles), material, np.uint8))
        self._labels.append(np.full(len(triangles), self.label, np.uint8))
        self._count += len(vertices)

    def quads(self, corners: NDArray[np.float64], material: Material) -> None:
        """Add quads [Q x 4 x 3], corners in order around each."""
        first = 4 * np.arange(len(corners))[:, None]
        triangles = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
        self.triangles(corners.reshape(-1, 3), triangles, material)

    def box(
        self,
        centre: NDArray[np.float64],
        size: tuple[float, float, float],
        yaw: float,
        material: Material,
    ) -> None:
        """Add a box turned about the vertical."""
        corners = _BOX_CORNERS * size @ turn(yaw).T + centre
        self.quads(corners[_BOX_QUADS], material)

    def prism(
        self,
        foot: NDArray[np.float64],
        height: float,
        radius: float,
        material: Material,
        sides: int = 6,
    ) -> None:
        """Add an upright prism (a pole, a trunk) without its caps."""
        angle = 2 * np.pi * np.arange(sides) / sides
        ring = foot + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        top = ring + up(height)
        after = np.roll(np.arange(sides), -1)
        self.quads(np.stack([ring, ring[after], top[after], top], axis=1), material)

    def build(self) -> Mesh:
        """Join everything."""
        return Mesh(
            np.concatenate(self._vertices).astype(np.float32),
            np.concatenate(self._triangles).astype(np.uint32),
            np.concatenate(self._materials),
            np.concatenate(self._labels),
        )


def turn(yaw: float) -> NDArray[np.float64]:
    """Return the 3x3 rotation about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def up(metres: float) -> NDArray[np.float64]:
    """Return the vector straight up."""
    return np.array([0.0, 0.0, metres])
