"""A start from two satellite fixes."""

import numpy as np
import pytest

from cmrnet_ekf.ekf.gnss_start import GnssStart, GnssStartConfig
from lcd_common import se3

COVARIANCE = 0.5**2 * np.eye(3)
LEVER = np.array([-0.5, 0.2, 1.5])


def test_heading_position_and_speed_come_from_the_way_between_two_fixes() -> None:
    start = GnssStart(GnssStartConfig())
    yaw, speed = 2.0, 8.0
    way = speed * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    assert start.add(0, np.zeros(3), COVARIANCE, LEVER) is None
    assert start.add(200_000_000, 0.2 * way, COVARIANCE, LEVER) is None  # too near
    found = start.add(1_000_000_000, way, COVARIANCE, LEVER)
    assert found is not None and found.stamp_ns == 1_000_000_000
    assert se3.yaw(found.T_map_base) == pytest.approx(yaw)
    antenna = se3.transform_points(found.T_map_base, LEVER[None])[0]
    np.testing.assert_allclose(antenna, way, atol=1e-12)
    np.testing.assert_allclose(found.velocity_map, way, atol=1e-12)
    assert se3.is_covariance(found.covariance)


def test_noise_while_standing_is_no_course() -> None:
    start = GnssStart(GnssStartConfig(baseline=1.0))
    rng = np.random.default_rng(0)
    for k in range(50):
        fix = rng.normal(size=3) * 0.5
        assert start.add(k * 100_000_000, fix, COVARIANCE, LEVER) is None


def test_an_old_fix_gives_no_course() -> None:
    start = GnssStart(GnssStartConfig(window=5.0))
    start.add(0, np.zeros(3), COVARIANCE, LEVER)
    assert start.add(6_000_000_000, np.array([50.0, 0, 0]), COVARIANCE, LEVER) is None
    start.clear()
    assert start.add(6_100_000_000, np.array([100.0, 0, 0]), COVARIANCE, LEVER) is None
