"""Candidates that odometry rules out, and the breaks after which it rules out nothing."""

from __future__ import annotations

import numpy as np

from lcd_common.cloud import PointCloud
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.odometry_reach import OdometryReach


def keyframe(id: int, x_m: float, sigma: float = 0.01) -> Keyframe:
    T = np.eye(4)
    T[0, 3] = x_m
    cloud = PointCloud(np.zeros((0, 3), np.float32))
    return Keyframe(id, id, T, np.eye(4), sigma**2 * np.eye(6), cloud)


def reach(positions_m: list[float], broken: int | None = None) -> OdometryReach:
    out, travelled = OdometryReach(0.3, 20.0), 0.0
    for i, x in enumerate(positions_m):
        travelled += abs(x - positions_m[i - 1]) if i else 0.0
        out.arrive(keyframe(i, x, 1.5 if i == broken else 0.01), travelled)
    return out


def test_what_lies_farther_than_drift_explains_is_not_plausible() -> None:
    straight = reach([0.0, 25.0, 50.0, 100.0])
    assert straight.plausible(0, 1)  # 25 m away, 20 m + 0.3 * 25 m allowed
    assert not straight.plausible(0, 2)  # 50 m, 35 m allowed
    assert not straight.plausible(0, 3)
    there_and_back = reach([0.0, 50.0, 100.0, 50.0, 0.0])
    assert there_and_back.plausible(0, 4) and there_and_back.plausible(1, 3)


def test_a_broken_link_in_between_makes_everything_plausible() -> None:
    broken = reach([0.0, 50.0, 100.0, 150.0], broken=2)
    assert broken.plausible(0, 3) and broken.plausible(1, 2)
    assert not broken.plausible(0, 1) and not broken.plausible(2, 3)


def test_keyframes_of_another_session_are_plausible() -> None:
    assert reach([0.0, 100.0]).plausible(77, 1)
    forgotten = reach([0.0, 100.0])
    forgotten.forget(0)
    assert forgotten.plausible(0, 1)
