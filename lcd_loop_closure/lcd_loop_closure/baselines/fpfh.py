"""Register clouds by FPFH features, with RANSAC or Fast Global Registration, in Open3D.

Rusu, Blodow and Beetz, "Fast Point Feature Histograms (FPFH) for 3D Registration", ICRA 2009; Zhou,
Park and Koltun, "Fast Global Registration", ECCV 2016.
"""

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.baselines.icp import thinned


@config
class FpfhConfig:
    """How features are made; lengths grow with the voxels, as in Open3D's own example."""

    voxel_size: float = setting(0.5, 'thinning of both clouds', unit='m', low=0.05)
    normal_radius: float = setting(2.0, 'points around for a normal, in voxels', low=1.0)
    normal_neighbours: int = setting(30, 'most of these points', low=3)
    feature_radius: float = setting(5.0, 'points around for a feature, in voxels', low=1.0)
    feature_neighbours: int = setting(100, 'most of these points', low=3)
    sensor_height: float = setting(
        1.73, 'of the LiDAR above the ground, to which normals point', unit='m', low=0.0
    )


@config
class RansacConfig:
    """How RANSAC searches."""

    inlier_distance: float = setting(1.0, 'largest distance of partners, in voxels', low=0.1)
    edge_similarity: float = setting(
        0.9, 'sides of the sampled triangles agree to this ratio', low=0.0, high=1.0
    )
    iterations: int = setting(100_000, 'samples at most', low=1)
    confidence: float = setting(0.999, 'of having found the best, to stop early', low=0.0, high=1.0)
    mutual: bool = setting(True, 'features must be nearest to each other')
    seed: int = setting(0, 'of the samples', low=0)


@config
class FgrConfig:
    """How Fast Global Registration solves."""

    inlier_distance: float = setting(1.0, 'of partners, in voxels', low=0.1)
    iterations: int = setting(64, 'of the solver', low=1)
    tuple_scale: float = setting(
        0.95, 'sides of the tested triples agree to this ratio', low=0.0, high=1.0
    )
    most_tuples: int = setting(10_000, 'triples kept at most', low=1)
    seed: int = setting(0, 'of the triples', low=0)


@dataclass(frozen=True)
class FeatureCloud:
    """A thinned cloud with a feature at each point, as Open3D holds them."""

    points: o3d.geometry.PointCloud
    features: o3d.pipelines.registration.Feature


class FpfhFeatures:
    """Make features."""

    def __init__(self, settings: FpfhConfig | None = None) -> None:
        self.settings = settings or FpfhConfig()

    def prepare(self, cloud: PointCloud) -> FeatureCloud:
        """Return the features of a cloud."""
        s = self.settings
        points = thinned(cloud, s.voxel_size)
        hybrid = o3d.geometry.KDTreeSearchParamHybrid
        points.estimate_normals(hybrid(s.normal_radius * s.voxel_size, s.normal_neighbours))
        # Without a side to look from, normals of one wall point both ways by chance.
        points.orient_normals_towards_camera_location([0.0, 0.0, s.sensor_height])
        features = o3d.pipelines.registration.compute_fpfh_feature(
            points, hybrid(s.feature_radius * s.voxel_size, s.feature_neighbours)
        )
        return FeatureCloud(points, features)


class FpfhRansac:
    """Register by sampled triangles of matched features."""

    name = 'fpfh_ransac'

    def __init__(
        self, settings: RansacConfig | None = None, features: FpfhConfig | None = None
    ) -> None:
        self.settings, self.features = settings or RansacConfig(), FpfhFeatures(features)

    def prepare(self, cloud: PointCloud) -> FeatureCloud:
        """Return the features of a cloud."""
        return self.features.prepare(cloud)

    def register(self, match: FeatureCloud, query: FeatureCloud) -> se3.Array | None:
        """Return T_match_query; None where fewer than three points agree."""
        s, ransac = self.settings, o3d.pipelines.registration
        gate = s.inlier_distance * self.features.settings.voxel_size
        o3d.utility.random.seed(s.seed)
        result = ransac.registration_ransac_based_on_feature_matching(
            query.points,
            match.points,
            query.features,
            match.features,
            s.mutual,
            gate,
            ransac.TransformationEstimationPointToPoint(False),
            3,
            [
                ransac.CorrespondenceCheckerBasedOnEdgeLength(s.edge_similarity),
                ransac.CorrespondenceCheckerBasedOnDistance(gate),
            ],
            ransac.RANSACConvergenceCriteria(s.iterations, s.confidence),
        )
        if len(result.correspondence_set) < 3:
            return None
        return np.array(result.transformation)


class FastGlobalRegistration:
    """Register by a robust cost over matched features, without sampling poses."""

    name = 'fgr'

    def __init__(
        self, settings: FgrConfig | None = None, features: FpfhConfig | None = None
    ) -> None:
        self.settings, self.features = settings or FgrConfig(), FpfhFeatures(features)

    def prepare(self, cloud: PointCloud) -> FeatureCloud:
        """Return the features of a cloud."""
        return self.features.prepare(cloud)

    def register(self, match: FeatureCloud, query: FeatureCloud) -> se3.Array | None:
        """Return T_match_query; None where the solver's answer is no number."""
        s, fgr = self.settings, o3d.pipelines.registration
        o3d.utility.random.seed(s.seed)
        result = fgr.registration_fgr_based_on_feature_matching(
            query.points,
            match.points,
            query.features,
            match.features,
            fgr.FastGlobalRegistrationOption(
                maximum_correspondence_distance=(
                    s.inlier_distance * self.features.settings.voxel_size
                ),
                iteration_number=s.iterations,
                tuple_scale=s.tuple_scale,
                maximum_tuple_count=s.most_tuples,
            ),
        )
        T_match_query = np.array(result.transformation)
        return T_match_query if np.isfinite(T_match_query).all() else None
