"""Look for the heading of a sweep that does not fit where it was expected."""

import numpy as np

from lcd_common import se3
from lcd_common.se3 import Array
from lcd_loop_closure.voxel_gaussians import VoxelGaussians

_RIVAL = 0.6  # of the best share: less is no rival


def yaw_candidates(
    points: Array,
    T_map_centres: list[Array],
    surfaces: VoxelGaussians,
    best: int,
    steps: int = 24,
    span: float = 2.0 * np.pi,
) -> list[Array]:
    """Return the poses under which most points fall where the map has matter, best first.

    Args:
        points: [N x 3] of the lidar frame.
        T_map_centres: poses to turn about their own z axes.
        surfaces: the map.
        best: how many to return at most; neighbours of a better one are left out,
            as is what cannot compare with the best.
        steps: headings tried in the span.
        span: of the headings, radians, half of it to each side.
    """
    step = span / steps
    poses = [
        T @ se3.rotation_z(angle)
        for T in T_map_centres
        for angle in (np.arange(steps) - steps // 2) * step
    ]
    placed = np.concatenate([se3.transform_points(T, points) for T in poses])
    share = (surfaces.find(placed, 2) >= 0).reshape(len(poses), -1).mean(axis=1)
    chosen: list[Array] = []
    for index in np.argsort(-share, kind='stable'):
        if share[index] < _RIVAL * share.max():
            break
        T = poses[index]
        if all(se3.distance(T, other)[1] > 1.25 * step for other in chosen):
            chosen.append(T)
        if len(chosen) == best:
            break
    return chosen
