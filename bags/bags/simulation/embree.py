"""Cast rays into a scene on the CPU: Open3D's Embree."""

import numpy as np
from numpy.typing import NDArray

from bags.simulation.hits import Hits
from bags.simulation.scene import Scene
from bags.street.mesh import Label

_SIGHT_M = 150.0
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
        moving = self._moving(np.asarray(origins, np.float64).reshape(-1, 3)[0], time_s)
        if moving is not None:
            vertices, triangles, owner, own = moving
            found = self._tree(vertices, triangles).cast_rays(rays_tensor)
            nearer = found['t_hit'].numpy() < range_m
            range_m = np.where(nearer, found['t_hit'].numpy(), range_m)
            normal[nearer] = found['primitive_normals'].numpy()[nearer]
            which = found['primitive_ids'].numpy().astype(np.int64)[nearer]
            mover[nearer], triangle[nearer] = owner[which], -1
            for index in np.unique(owner[which]):
                mesh, rows = self.scene.movers[index].mesh, own[which[owner[which] == index]]
                at = np.flatnonzero(nearer)[owner[which] == index]
                material[at] = mesh.materials[rows]
                label[at] = [_MOVING.get(Label(i), i) for i in mesh.labels[rows]]
        incidence = np.abs(np.einsum('ij,ij->i', normal, rays[:, 3:]))
        return Hits(
            range_m, incidence.astype(np.float32), triangle.astype(np.int32), material, label, mover
        )

    def _moving(
        self, origin: NDArray[np.float64], time_s: float
    ) -> (
        tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.int16], NDArray[np.int64]] | None
    ):
        """Return all movers near a point as one mesh, with each triangle's mover and own number."""
        vertices, triangles, owner, own, count = [], [], [], [], 0
        for index, mover in enumerate(self.scene.movers):
            T = mover.at(time_s)
            if T is None or np.linalg.norm(T[:3, 3] - origin) > _SIGHT_M:
                continue
            vertices.append((mover.mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
            triangles.append(mover.mesh.triangles + np.uint32(count))
            count += len(mover.mesh.vertices)
            owner.append(np.full(len(triangles[-1]), index, np.int16))
            own.append(np.arange(len(triangles[-1])))
        if not vertices:
            return None
        return (
            np.concatenate(vertices),
            np.concatenate(triangles),
            np.concatenate(owner),
            np.concatenate(own),
        )

    def _tree(self, vertices: NDArray[np.float32], triangles: NDArray[np.uint32]):  # type: ignore[no-untyped-def]
        tree = self._o3d.t.geometry.RaycastingScene()
        tensor = self._o3d.core.Tensor
        tree.add_triangles(tensor(vertices), tensor(triangles))
        return tree
