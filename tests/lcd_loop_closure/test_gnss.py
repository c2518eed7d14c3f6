"""Satellite fixes find where the map lies and hold it there."""

import gtsam
import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.gnss import GnssConfig, GnssDatum, GnssFactor, GnssFix, align, gnss_factor
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.pose_graph import PoseGraph

KARLSRUHE = GnssDatum(49.01, 8.43, 116.0)
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))
EAST_NORTH = np.diag([0.25, 0.25, 1.0])


def fix_at(enu: np.ndarray, stamp_ns: int = 0) -> GnssFix:
    """Return the fix of a point in Karlsruhe's ENU frame, by Newton's method."""
    position = np.array([KARLSRUHE.latitude_deg, KARLSRUHE.longitude_deg, KARLSRUHE.altitude_m])
    for _ in range(5):
        here = KARLSRUHE.enu(*position)
        J = np.stack(
            [(KARLSRUHE.enu(*(position + d)) - here) / 1e-6 for d in np.eye(3) * 1e-6], axis=1
        )
        position = position + np.linalg.solve(J, enu - here)
    return GnssFix(stamp_ns, *position.tolist(), EAST_NORTH)


def test_enu_agrees_with_the_ellipsoid_s_radii() -> None:
    # Oracle: radii of curvature of WGS 84 at this latitude, independent of the ECEF detour.
    a, e2 = 6378137.0, 6.69437999014e-3
    s = np.sin(np.radians(49.01))
    meridian = a * (1 - e2) / (1 - e2 * s**2) ** 1.5
    parallel = a / np.sqrt(1 - e2 * s**2) * np.cos(np.radians(49.01))
    north = KARLSRUHE.enu(49.011, 8.43, 116.0)
    east = KARLSRUHE.enu(49.01, 8.431, 116.0)
    up = KARLSRUHE.enu(49.01, 8.43, 126.0)
    assert north[1] == pytest.approx((meridian + 116.0) * np.radians(0.001), rel=1e-5)
    assert east[0] == pytest.approx(parallel * (1 + 116.0 / a) * np.radians(0.001), rel=1e-5)
    np.testing.assert_allclose(up, [0, 0, 10], atol=1e-8)


def test_alignment_survives_reflections_and_asks_for_a_baseline() -> None:
    rng = np.random.default_rng(0)
    positions = np.stack([np.linspace(0, 200, 60), 30 * np.sin(np.linspace(0, 3, 60)), [0] * 60], 1)
    T_enu_map = se3.rotation_z(2.0)
    T_enu_map[:3, 3] = [5.0, -7.0, 3.0]
    enu = se3.transform_points(T_enu_map, positions) + rng.normal(0, 0.3, (60, 3))
    enu[20:26] += [40.0, 0.0, 10.0]
    found = align(positions, enu, GnssConfig())
    assert found is not None
    metres, radians = se3.distance(T_enu_map, found)
    assert metres < 0.5 and radians < 0.01
    assert align(positions[:5], enu[:5], GnssConfig()) is None


def test_the_factor_knows_the_lever_arm() -> None:
    T_map_base = se3.exp([4.0, 5.0, 6.0, 0.1, 0.2, 1.5])
    lever = np.array([1.0, -0.5, 1.6])
    T_enu_map = se3.exp([10.0, 20.0, 0.0, 0, 0, 0.7])
    position = se3.transform_points(T_enu_map @ T_map_base, lever[None])[0]
    factor = gnss_factor(GnssFactor(0, position, EAST_NORTH, lever), T_enu_map, 0)
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(T_map_base))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        ({'latitude_deg': float('nan')}, 'on the Earth'),
        ({'latitude_deg': 95.0}, 'on the Earth'),
        ({'covariance_enu': np.eye(3) * 1e4}, 'worse than the limit'),
        ({'covariance_enu': np.full((3, 3), np.nan)}, 'finite 3 x 3'),
    ],
)
def test_useless_fixes_are_refused_with_a_reason(change: dict, says: str) -> None:
    values = {'stamp_ns': 0, 'latitude_deg': 49.0, 'longitude_deg': 8.4, 'altitude_m': 0.0}
    fix = GnssFix(**{**values, 'covariance_enu': EAST_NORTH, **change})
    graph = PoseGraph()
    graph.add_keyframe(Keyframe(0, 1, np.eye(4), np.eye(4), None, NO_POINTS))
    with pytest.raises(DataError, match=says):
        graph.add_gnss(fix, np.eye(4))


def test_fixes_straighten_a_bent_drive() -> None:
    """Odometry that turns by 0.2 degrees a keyframe is held by fixes; loops are not needed."""
    rng = np.random.default_rng(1)
    T_enu_world = se3.rotation_z(1.0)
    lever = se3.from_rotation_translation(np.eye(3), [0.5, 0.2, 1.5])
    motion = se3.exp([2.0, 0, 0, 0, 0, 0.01])
    wrong = motion @ se3.rotation_z(np.radians(0.2))
    graph = PoseGraph()
    with pytest.raises(DataError, match='before the first'):
        graph.add_gnss(fix_at(np.zeros(3)), lever)
    T_world, T_odom, truth, odometry = np.eye(4), np.eye(4), [], []
    for k in range(200):
        if k:
            T_world, T_odom = T_world @ motion, T_odom @ wrong
        truth.append(T_world)
        odometry.append(T_odom)
        step = wrong if k else np.eye(4)
        graph.add_keyframe(Keyframe(k, k + 1, T_odom, step, diagonal(0.02, 4e-3), NO_POINTS))
        ahead = se3.exp([0.3, 0, 0, 0, 0, 0])  # the fix came a moment after the keyframe
        antenna = (T_enu_world @ T_world @ ahead @ lever)[:3, 3]
        noise = rng.normal(0, 0.3, 3) + ([30, 0, 0] if k % 37 == 36 else [0, 0, 0])
        graph.add_gnss(fix_at(antenna + noise), lever, ahead)
        graph.update()
        if k < 10:
            assert graph.T_enu_map is None
    assert graph.T_enu_map is not None and graph.gnss_datum is not None
    T_enu_base = graph.T_enu_map @ graph.poses()
    # The datum is the first, noisy fix of the antenna: compare shapes up to that shift.
    offset = T_enu_world @ np.array(truth)
    difference = T_enu_base[:, :3, 3] - offset[:, :3, 3]
    difference -= difference.mean(axis=0)
    assert np.sqrt((difference**2).sum(axis=1).mean()) < 0.4
    bent = np.linalg.norm(np.array(odometry)[-1, :3, 3] - np.array(truth)[-1, :3, 3])
    assert bent > 10.0
    turn = se3.rotation_angle(se3.inverse(T_enu_base[150]) @ offset[150])
    assert turn < np.radians(1.0)
    restored = PoseGraph.restore(graph.snapshot())
    np.testing.assert_allclose(restored.poses(), graph.poses(), atol=0.1)
