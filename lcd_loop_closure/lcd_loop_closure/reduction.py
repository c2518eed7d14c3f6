"""Reduce a sweep to what a keyframe keeps."""

import numpy as np

from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.settings import config, setting


@config
class ReductionConfig:
    """How many points of a sweep are remembered: at most 16 bytes each, 192 kB by default."""

    voxel_size: float = setting(0.4, 'one measured point is kept per voxel', unit='m', low=0.02)
    min_range: float = setting(
        2.5, 'nearer returns are dropped: they are the vehicle itself', unit='m', low=0.0
    )
    max_range: float = setting(80.0, 'farther returns are dropped', unit='m', low=5.0)
    max_points: int = setting(12000, 'voxels grow until no more points remain', low=500)


def reduce_cloud(cloud: PointCloud, settings: ReductionConfig) -> PointCloud:
    """Return measured points of a sweep, evenly spread; times are dropped, intensity is kept.

    Ranges are measured from the frame of the cloud.
    """
    kept = cloud.finite().within(settings.min_range, settings.max_range)
    kept = PointCloud(kept.xyz, kept.intensity)
    voxel_size = settings.voxel_size
    chosen = voxel_first(kept.xyz, voxel_size)
    while len(chosen) > settings.max_points:
        # Points lie on surfaces: their number falls with the square of the voxel.
        voxel_size *= 1.02 * np.sqrt(len(chosen) / settings.max_points)
        chosen = voxel_first(kept.xyz, voxel_size)
    return kept.select(chosen)
