"""Scan triangles with a spinning multi-beam LiDAR (Embree ray casting)."""

import numpy as np
from numpy.typing import NDArray

from bags.street.mesh import REFLECTIVITY, RETURN_SHARE, Mesh
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting


@config
class LidarConfig:
    """A 64-beam scanner with the elevations of Velodyne's HDL-64E."""

    columns: int = setting(720, 'azimuth steps of a sweep (the real one has about 2000)', low=16)
    rate: float = setting(10.0, 'sweeps per second', unit='Hz', low=0.1, high=100.0)
    min_range: float = setting(1.5, 'nearest return', unit='m', low=0.0)
    max_range: float = setting(100.0, 'farthest return', unit='m', low=1.0)
    range_noise: float = setting(0.02, 'standard deviation of a range', unit='m', low=0.0)
    dropout: float = setting(0.02, 'share of the returns lost at random', low=0.0, high=1.0)
    point_time: bool = setting(
        False, 'sweep while driving and give each point its time; off: the sweep is a snapshot'
    )


class SpinningLidar:
    """Cast the rays of a sweep, clockwise from straight behind, top beam first."""

    def __init__(self, mesh: Mesh, settings: LidarConfig) -> None:
        self.settings = settings
        import open3d as o3d  # takes seconds; only those who scan wait

        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(mesh.vertices), self._tensor(mesh.triangles))
        self._materials = mesh.materials
        # 32 beams 1/3 degree apart from +2, 32 beams 1/2 degree apart down to -24.8.
        elevation = np.radians(
            np.concatenate([np.linspace(2.0, -8.33, 32), np.linspace(-8.87, -24.8, 32)])
        )
        azimuth = np.pi - 2 * np.pi * np.arange(settings.columns) / settings.columns
        self._directions = np.stack(
            [
                np.cos(azimuth)[:, None] * np.cos(elevation),
                np.sin(azimuth)[:, None] * np.cos(elevation),
                np.broadcast_to(np.sin(elevation), (settings.columns, 64)),
            ],
            axis=-1,
        )
        self.column_time_s = np.arange(settings.columns) / settings.columns / settings.rate

    def scan(self, T_world_lidar: se3.Array, rng: np.random.Generator) -> PointCloud:
        """Return one sweep in the sensor's frame.

        Args:
            T_world_lidar: one pose [4 x 4] of a snapshot, or one for each column [C x 4 x 4]: the
                points are then in the frames of their own columns, as a moving scanner gives them.
            rng: of noise and dropout.
        """
        poses = np.broadcast_to(T_world_lidar, (self.settings.columns, 4, 4))
        rays = np.empty((self.settings.columns, 64, 6), np.float32)
        rays[..., :3] = poses[:, None, :3, 3]
        rays[..., 3:] = np.einsum('cij,cbj->cbi', poses[:, :3, :3], self._directions)
        answer = self._scene.cast_rays(self._tensor(rays.reshape(-1, 6)))
        distance = answer['t_hit'].numpy().astype(np.float64)
        hit = np.flatnonzero(distance < self.settings.max_range)
        distance = distance[hit]
        normal = answer['primitive_normals'].numpy()[hit]
        incidence = np.abs(np.einsum('ij,ij->i', normal, rays.reshape(-1, 6)[hit, 3:]))
        material = self._materials[answer['primitive_ids'].numpy()[hit]]
        keep, intensity = self._returned(distance, incidence, material, rng)
        distance = distance + rng.normal(0.0, self.settings.range_noise, len(distance))
        keep &= distance > self.settings.min_range
        hit = hit[keep]
        xyz = self._directions.reshape(-1, 3)[hit] * distance[keep, None]
        time_s = None
        if self.settings.point_time:
            time_s = self.column_time_s[hit // 64].astype(np.float32)
        return PointCloud(xyz.astype(np.float32), intensity[keep].astype(np.float32), time_s)

    def _returned(
        self,
        distance: NDArray[np.float64],
        incidence: NDArray[np.float64],
        material: NDArray[np.uint8],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Tell which rays come back, and how bright (0..1): weak echoes from afar are lost."""
        echo = REFLECTIVITY[material] * (0.15 + 0.85 * incidence)
        share = RETURN_SHARE[material] * (1.0 - self.settings.dropout)
        share *= np.clip(1.6 - distance / (100.0 * np.sqrt(echo / 0.15)), 0.0, 1.0)
        intensity = np.clip(echo + rng.normal(0.0, 0.02, len(echo)), 0.0, 1.0)
        return rng.random(len(echo)) < share, intensity
