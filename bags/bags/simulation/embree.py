"""Cast rays into a scene on the CPU: Open3D's Embree."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bags.simulation.hits import Hits
from bags.simulation.scene import Scene
from bags.street.mesh import MOVING


@dataclass(frozen=True)
class Nearest:
    """The nearest triangle along each ray.

    Attributes:
        range_m: [N] along the unit ray; infinity where it hits nothing.
        normal: [N x 3] of the triangle, world frame, on either side of it; 0 where nothing is hit.
        triangle: [N] of the scene's mesh, or of the mover's mesh where `mover` >= 0; -1 for none.
        mover: [N] index of the scene's mover, -1 otherwise.
    """

    range_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    triangle: NDArray[np.int32]
    mover: NDArray[np.int16]


@dataclass(frozen=True)
class _Placed:
    """All movers of one moment in one tree; `index` [G] is the mover of each of its geometries."""

    time_s: float
    tree: Any
    index: NDArray[np.int16]


class EmbreeCaster:
    """Hold the standing part of a scene ready; movers are placed anew for each moment."""

    def __init__(self, scene: Scene) -> None:
        """Build the tree over the scene's triangles."""
        import open3d as o3d  # takes seconds; only those who cast wait

        self._o3d = o3d
        self.scene = scene
        self._standing = self._tree()
        self._add(self._standing, scene.mesh.vertices, scene.mesh.triangles)
        self._placed: _Placed | None = None

    def cast(
        self,
        origins: NDArray[np.floating],
        directions: NDArray[np.floating],
        time_s: float = 0.0,
    ) -> Hits:
        """Return what rays hit.

        Args:
            origins: [N x 3] (or broadcast to it), world frame, metres.
            directions: [N x 3] unit vectors.
            time_s: where the movers are, seconds since the drive's start.
        """
        found = self.nearest(origins, directions, time_s)
        mesh = self.scene.mesh
        standing = (found.triangle >= 0) & (found.mover < 0)
        triangle = np.where(standing, found.triangle, -1)
        material = np.where(standing, mesh.materials[triangle], 0).astype(np.uint8)
        label = np.where(standing, mesh.labels[triangle], 0).astype(np.uint8)
        moving = np.flatnonzero(found.mover >= 0)
        for index in np.unique(found.mover[moving]):
            at = moving[found.mover[moving] == index]
            other, own = self.scene.movers[index].mesh, found.triangle[at]
            material[at] = other.materials[own]
            label[at] = MOVING[other.labels[own]]
        incidence = np.abs(np.einsum('ij,ij->i', found.normal, directions))
        return Hits(
            found.range_m, incidence.astype(np.float32), triangle, material, label, found.mover
        )

    def nearest(
        self,
        origins: NDArray[np.floating],
        directions: NDArray[np.floating],
        time_s: float = 0.0,
    ) -> Nearest:
        """Return the nearest triangles and their normals; arguments as for `cast`."""
        return self.nearest_along(_rays(origins, directions), time_s)

    def nearest_along(self, rays: NDArray[np.float32], time_s: float = 0.0) -> Nearest:
        """Return the nearest triangles along rays [N x 6]: origin, unit direction; no copy made."""
        along = self._o3d.core.Tensor.from_numpy(rays)
        found = self._standing.cast_rays(along)
        range_m = found['t_hit'].numpy()
        normal = found['primitive_normals'].numpy()
        # Embree says "none" by the highest number of 32 bits, which is -1 as a signed one.
        triangle = found['primitive_ids'].numpy().view(np.int32)
        mover = np.full(len(range_m), -1, np.int16)
        placed = self._movers(time_s)
        if placed is not None:
            found = placed.tree.cast_rays(along)
            nearer = np.flatnonzero(found['t_hit'].numpy() < range_m)
            range_m[nearer] = found['t_hit'].numpy()[nearer]
            normal[nearer] = found['primitive_normals'].numpy()[nearer]
            triangle[nearer] = found['primitive_ids'].numpy().view(np.int32)[nearer]
            mover[nearer] = placed.index[found['geometry_ids'].numpy()[nearer]]
        return Nearest(range_m, normal, triangle, mover)

    def blocked(
        self,
        origins: NDArray[np.floating],
        directions: NDArray[np.floating],
        time_s: float = 0.0,
    ) -> NDArray[np.bool_]:
        """Return whether anything lies on each ray [N]; arguments as for `cast`."""
        rays = self._o3d.core.Tensor.from_numpy(_rays(origins, directions))
        blocked = np.asarray(self._standing.test_occlusions(rays).numpy())
        placed = self._movers(time_s)
        if placed is not None:
            blocked = blocked | placed.tree.test_occlusions(rays).numpy()
        return blocked

    def _movers(self, time_s: float) -> _Placed | None:
        """Return the movers where they are at a time, or None when there are none."""
        if self._placed is None or self._placed.time_s != time_s:
            tree, present = self._tree(), []
            for index, mover in enumerate(self.scene.movers):
                T = mover.at(time_s)
                if T is None:
                    continue
                at = mover.mesh.vertices @ T[:3, :3].T.astype(np.float32) + T[:3, 3]
                self._add(tree, at.astype(np.float32), mover.mesh.triangles)
                present.append(index)
            self._placed = _Placed(time_s, tree, np.array(present, np.int16))
        return self._placed if len(self._placed.index) else None

    def _tree(self) -> Any:
        return self._o3d.t.geometry.RaycastingScene()

    def _add(self, tree: Any, vertices: NDArray[np.float32], of: NDArray[np.uint32]) -> None:
        tensor = self._o3d.core.Tensor
        tree.add_triangles(tensor(vertices), tensor(of))


def _rays(origins: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.float32]:
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3], rays[:, 3:] = origins, directions
    return rays
