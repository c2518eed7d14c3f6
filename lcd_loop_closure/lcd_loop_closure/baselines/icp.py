"""Register clouds from the identity by the iterative closest point algorithm, in Open3D.

Besl and McKay 1992 (point-to-point), Chen and Medioni 1991 (point-to-plane): the thesis's rows
"ICP (P2p)" and "ICP (P2pl)".
"""

import numpy as np
import open3d as o3d

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting


@config
class IcpConfig:
    """What ICP is given."""

    planes: bool = setting(False, 'distances to planes at the points, not to the points')
    voxel_size: float = setting(0.3, 'thinning of both clouds, as in the thesis', unit='m', low=0.0)
    gates: tuple[float, ...] = setting(
        (5.0, 2.0, 0.6),
        'largest distance of partners, in passes: the first ones let it come from far',
        unit='m',
        low=0.01,
    )
    iterations: int = setting(50, 'of each pass', low=1)
    normal_radius: float = setting(1.0, 'points around that make a plane', unit='m', low=0.05)
    normal_neighbours: int = setting(30, 'most of these points', low=3)


class Icp:
    """Register from the identity or refine a guess."""

    def __init__(self, settings: IcpConfig | None = None) -> None:
        self.settings = settings or IcpConfig()
        self.name = 'icp_point_to_plane' if self.settings.planes else 'icp_point_to_point'

    def prepare(self, cloud: PointCloud) -> o3d.geometry.PointCloud:
        """Thin a cloud out and, for planes, estimate its normals."""
        s = self.settings
        points = thinned(cloud, s.voxel_size)
        if s.planes:
            points.estimate_normals(
                o3d.geometry.KDTreeSearchParamHybrid(s.normal_radius, s.normal_neighbours)
            )
        return points

    def register(self, match: o3d.geometry.PointCloud, query: o3d.geometry.PointCloud) -> se3.Array:
        """Return T_match_query, coming from the identity through all passes."""
        T_match_query = np.eye(4)
        for gate in self.settings.gates:
            T_match_query = self._pass(match, query, T_match_query, gate)
        return T_match_query

    def refine(
        self,
        match: o3d.geometry.PointCloud,
        query: o3d.geometry.PointCloud,
        T_match_query: se3.Array,
    ) -> se3.Array:
        """Return the pose that a guess leads to: the last pass only."""
        return self._pass(match, query, T_match_query, self.settings.gates[-1])

    def _pass(
        self,
        match: o3d.geometry.PointCloud,
        query: o3d.geometry.PointCloud,
        T_match_query: se3.Array,
        gate: float,
    ) -> se3.Array:
        icp = o3d.pipelines.registration
        estimation = (
            icp.TransformationEstimationPointToPlane()
            if self.settings.planes
            else icp.TransformationEstimationPointToPoint(False)
        )
        criteria = icp.ICPConvergenceCriteria(1e-6, 1e-6, self.settings.iterations)
        result = icp.registration_icp(query, match, gate, T_match_query, estimation, criteria)
        return np.array(result.transformation)


def thinned(cloud: PointCloud, voxel_size: float) -> o3d.geometry.PointCloud:
    """Return the means of the points in each voxel as Open3D's cloud; 0 keeps all points."""
    xyz = cloud.finite().xyz.astype(np.float64)
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    return points.voxel_down_sample(voxel_size) if voxel_size > 0 else points
