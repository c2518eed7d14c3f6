"""The heading of a sweep that was turned is among the first candidates."""

import numpy as np
import pytest
from odometry_drives import drive

from lcd_common import se3
from lcd_loop_closure.voxel_gaussians import VoxelGaussians
from lcd_loop_closure.yaw_search import yaw_candidates


@pytest.mark.parametrize('degrees', [40, 95, 180, -130])
def test_the_turn_is_found(degrees: float) -> None:
    first, second = drive('corner', 0, tuple(range(20, 50)))[:2]
    surfaces = VoxelGaussians(1.0, 100.0)
    surfaces.add(first.cloud.xyz.astype(float), np.zeros(3))
    T_true = se3.rotation_z(np.radians(degrees))
    points = se3.transform_points(se3.inverse(T_true), second.cloud.xyz.astype(float)[::40])
    candidates = yaw_candidates(points, [np.eye(4)], surfaces, best=4)
    assert len(candidates) == 4
    angles = [se3.distance(T, T_true)[1] for T in candidates]
    assert np.degrees(min(angles)) <= 7.5 + 1e-6  # half of the search's step
    apart = [se3.distance(a, b)[1] for i, a in enumerate(candidates) for b in candidates[:i]]
    assert np.degrees(min(apart)) > 29.9
