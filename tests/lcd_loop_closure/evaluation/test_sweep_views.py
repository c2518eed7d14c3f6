import numpy as np
import pytest
from evaluation_samples import World, out_and_back

from lcd_common.cloud import PointCloud
from lcd_loop_closure.evaluation.sweep_views import (
    Aggregated,
    Joined,
    RearBlocked,
    SectorRemoved,
    without_sector,
)


@pytest.fixture(scope='module')
def world():
    return World(out_and_back(45.0))


def circle(count: int = 3600) -> PointCloud:
    angle = np.linspace(-np.pi, np.pi, count, endpoint=False)
    return PointCloud(
        np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]).astype(np.float32) * 10
    )


@pytest.mark.parametrize('middle_deg', [0.0, 100.0, 179.0, -179.0])
@pytest.mark.parametrize('width_deg', [45.0, 90.0])
def test_a_sector_of_its_width_is_gone(middle_deg, width_deg):
    left = without_sector(circle(), np.radians(middle_deg), np.radians(width_deg))
    assert 1 - len(left) / 3600 == pytest.approx(width_deg / 360, abs=1e-3)
    azimuth = np.degrees(np.arctan2(left.xyz[:, 1], left.xyz[:, 0]))
    apart = np.abs((azimuth - middle_deg + 180) % 360 - 180)
    assert apart.min() == pytest.approx(width_deg / 2, abs=0.2)


def test_every_scan_loses_a_sector_of_its_own_and_always_the_same(world):
    view, again = SectorRemoved(world, 90.0, seed=3), SectorRemoved(world, 90.0, seed=3)
    other = SectorRemoved(world, 90.0, seed=4)
    middles = []
    for k in range(8):
        whole, left = world.cloud(k), view.cloud(k)
        assert np.array_equal(left.xyz, again.cloud(k).xyz)
        assert not np.array_equal(left.xyz, other.cloud(k).xyz)
        gone = {tuple(p) for p in whole.xyz} - {tuple(p) for p in left.xyz}
        lost = np.array(sorted(gone))
        middles.append(np.arctan2(*lost[:, 1::-1].mean(0)))
        assert 0.15 < len(gone) / len(whole) < 0.35
    assert np.ptp(middles) > 1.0
    assert view.name == again.name != other.name


def test_the_rear_is_blocked(world):
    left = RearBlocked(world, 70.0).cloud(2).xyz
    azimuth = np.degrees(np.arctan2(left[:, 1], left[:, 0]))
    assert np.abs(azimuth).max() <= 145.0
    assert (np.abs(azimuth) > 140.0).any()


def test_aggregation_fills_what_is_blocked_from_the_metres_before(world):
    blocked = RearBlocked(world, 70.0)
    whole = Aggregated(blocked, behind_m=12.0, step_m=3.0)
    at = 8
    seen = whole.cloud(at).xyz
    behind = np.abs(np.degrees(np.arctan2(seen[:, 1], seen[:, 0]))) > 150.0
    assert behind.sum() > 100
    # The world stands still: every point is one of the world, in the frame of this sweep.
    from scipy.spatial import cKDTree

    T = world.T_world_base[at]
    away, _ = cKDTree(world._points).query(seen @ T[:3, :3].T + T[:3, 3])
    assert away.max() < 1e-4
    # Nothing of the sweeps after it, and the first sweep has only itself.
    first = whole.cloud(0).xyz
    assert {tuple(p) for p in first} <= {tuple(p) for p in blocked.cloud(0).xyz}


def test_drives_one_after_the_other(world):
    both = Joined([world, RearBlocked(world)], 'both')
    number = len(world.T_world_base)
    assert len(both.T_world_base) == 2 * number
    assert np.array_equal(both.cloud(number - 1).xyz, world.cloud(number - 1).xyz)
    assert np.array_equal(both.cloud(number).xyz, RearBlocked(world).cloud(0).xyz)
