"""Cast rays into a scene on the CPU: Open3D's Embree."""

import numpy as np
from numpy.typing import NDArray

from bags.simulation.hits import Hits
from bags.simulation.scene import Scene
from bags.street.mesh import Label

_MOVING = {Label.CAR: Label.MOVING_CAR, Label.PERSON: Label.MOVING_PERSON}


class EmbreeCaster:
    """Hold the standing part of a scene ready; movers are placed anew for each cast."""

    def __init__(self, scene: Scene) -> None:
        """Build the tree over the scene's triangles."""
        import open3d as o3d  # takes seconds; only those who cast wait

        self._o3d = o3d
        self.scene = scene
        self._standing = self._tree(scene.mesh.vertices, scene.mesh.triangles)

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
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        rays_tensor = self._o3d.core.Tensor(rays)
        found = self._standing.cast_rays(rays_tensor)
        mesh = self.scene.mesh
        range_m = found['t_hit'].numpy()
        hit = np.isfinite(range_m)
        triangle = np.where(hit, found['primitive_ids'].numpy().astype(np.int64), -1)
        normal = found['primitive_normals'].numpy()
        material = np.where(hit, mesh.materials[triangle], 0).astype(np.uint8)
        label = np.where(hit, mesh.labels[triangle], 0).astype(np.uint8)
        mover = np.full(len(rays), -1, np.int16)
        for index, other in enumerate(self.scene.movers):
            T = other.at(time_s)
            if T is None:
                continue
            placed = other.mesh.vertices @ T[:3, :3].T.astype(np.float32) + T[:3, 3]
            moved = self._tree(placed.astype(np.float32), other.mesh.triangles)
            found = moved.cast_rays(rays_tensor)
            nearer = found['t_hit'].numpy() < range_m
            if not nearer.any():
                continue
            range_m = np.where(nearer, found['t_hit'].numpy(), range_m)
            normal[nearer] = found['primitive_normals'].numpy()[nearer]
            own = found['primitive_ids'].numpy().astype(np.int64)[nearer]
            material[nearer] = other.mesh.materials[own]
            label[nearer] = [_MOVING.get(Label(i), i) for i in other.mesh.labels[own]]
            triangle[nearer], mover[nearer] = -1, index
        incidence = np.abs(np.einsum('ij,ij->i', normal, rays[:, 3:]))
        return Hits(
            range_m, incidence.astype(np.float32), triangle.astype(np.int32), material, label, mover
        )

    def _tree(self, vertices: NDArray[np.float32], triangles: NDArray[np.uint32]):  # type: ignore[no-untyped-def]
        tree = self._o3d.t.geometry.RaycastingScene()
        tensor = self._o3d.core.Tensor
        tree.add_triangles(tensor(vertices), tensor(triangles))
        return tree
