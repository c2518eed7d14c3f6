"""Register clouds from the identity by GICP, in small_gicp.

Segal et al., "Generalized-ICP", RSS 2009; Koide, "small_gicp", JOSS 2024.
"""

import numpy as np
import small_gicp

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting

Prepared = tuple[small_gicp.PointCloud, small_gicp.KdTree]


@config
class GicpConfig:
    """What small_gicp is given."""

    voxel_size: float = setting(0.3, 'thinning of both clouds', unit='m', low=0.01)
    neighbours: int = setting(10, 'points from which the surface at a point is estimated', low=5)
    gate: float = setting(2.0, 'largest distance of partners', unit='m', low=0.01)
    refining_gate: float = setting(1.0, 'the same when a guess is refined', unit='m', low=0.01)
    iterations: int = setting(50, 'at most', low=1)
    threads: int = setting(1, 'of small_gicp; one repeats exactly', low=1)


class Gicp:
    """Register from the identity or refine a guess."""

    name = 'small_gicp'

    def __init__(self, settings: GicpConfig | None = None) -> None:
        self.settings = settings or GicpConfig()

    def prepare(self, cloud: PointCloud) -> Prepared:
        """Thin a cloud out and estimate its surface."""
        s = self.settings
        xyz = cloud.finite().xyz.astype(np.float64)
        points, tree = small_gicp.preprocess_points(xyz, s.voxel_size, s.neighbours, s.threads)
        return points, tree

    def register(self, match: Prepared, query: Prepared) -> se3.Array:
        """Return T_match_query, coming from the identity."""
        return self._align(match, query, np.eye(4), self.settings.gate)

    def refine(self, match: Prepared, query: Prepared, T_match_query: se3.Array) -> se3.Array:
        """Return the pose that a guess leads to."""
        return self._align(match, query, T_match_query, self.settings.refining_gate)

    def _align(
        self, match: Prepared, query: Prepared, T_match_query: se3.Array, gate: float
    ) -> se3.Array:
        result = small_gicp.align(
            match[0],
            query[0],
            match[1],
            T_match_query,
            max_correspondence_distance=gate,
            num_threads=self.settings.threads,
            max_iterations=self.settings.iterations,
        )
        return np.asarray(result.T_target_source)
