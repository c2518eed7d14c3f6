"""Odometry equals KISS-ICP where it should, the truth in simulation, and notices its failures."""

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from odometry_drives import drive, follow, motion_error, step_ratios

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure import kiss_registration
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryConfig

RNG = np.random.default_rng(7)
CORNER = tuple(range(20, 50))
STEP_NS = 100_000_000


def kiss_icp(clouds: list[np.ndarray]) -> list[np.ndarray]:
    config = KISSConfig()
    config.data.deskew, config.mapping.voxel_size = False, 1.0
    config.registration.max_num_threads = 1
    kiss, poses = KissICP(config), []
    for xyz in clouds:
        kiss.register_frame(xyz.astype(np.float64), np.empty(0))
        poses.append(kiss.last_pose)
    return poses


def test_without_the_polish_real_sweeps_get_the_poses_of_kiss_icp(real_data: Path) -> None:
    folder = real_data / 'kitti_odometry' / 'sequences' / '00' / 'velodyne'
    files = sorted(folder.glob('0000[01]?.bin'))[:8]
    clouds = [np.fromfile(f, np.float32).reshape(-1, 4)[:, :3] for f in files]
    odometry = LidarOdometry(OdometryConfig(polish=False, threads=1))
    # The search of the first motion is not KISS-ICP's; there it starts from standing.
    odometry._first_twist = lambda sweep, step_s: np.zeros(6)
    stamps = [10**18 + i * STEP_NS for i in range(len(clouds))]
    ours = [
        odometry.register(PointCloud(xyz), stamp) for xyz, stamp in zip(clouds, stamps, strict=True)
    ]
    theirs = kiss_icp(clouds)
    assert len(ours) == 8 and theirs[-1][0, 3] > 5.0
    assert all(estimate.healthy for estimate in ours)
    for estimate, T in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(estimate.T_odom_lidar, T, rtol=0, atol=1e-9)


def test_the_environment_does_not_change_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('kiss_icp_data', '{"max_range": 5.0}')
    samples = drive('corner', 0, CORNER)[:2]
    _, estimates = follow(samples)
    assert np.linalg.norm(motion_error(samples, estimates, 0, 1)[:3]) < 0.05


def test_a_corner_is_followed_to_centimetres() -> None:
    samples = drive('corner', 0, CORNER)
    _, estimates = follow(samples)
    error = motion_error(samples, estimates, 0, len(samples) - 1)
    assert np.linalg.norm(error[:3]) < 0.1
    assert np.linalg.norm(error[3:]) < 2e-3
    assert all(e.healthy and not e.recovered and e.reason == '' for e in estimates)
    assert estimates[0].T_previous_this is None and estimates[0].covariance is None
    chained = np.eye(4)
    for estimate in estimates[1:]:
        chained = chained @ estimate.T_previous_this
        np.testing.assert_allclose(chained, estimate.T_odom_lidar, atol=1e-9)
        assert se3.is_covariance(estimate.covariance) and se3.is_covariance(estimate.growth)


def test_the_polish_brings_the_poses_nearer_to_the_truth() -> None:
    samples = drive('corner', 0, CORNER)
    rms = []
    for polish in (True, False):
        _, estimates = follow(samples, polish=polish)
        errors = [motion_error(samples, estimates, i - 1, i)[:3] for i in range(6, len(samples))]
        rms.append(np.sqrt(np.mean(np.square(errors))))
    assert rms[0] < 0.5 * rms[1]


@pytest.mark.parametrize(
    ('into_sweep_s', 'error_m'),
    # From the middle of the sweep the begin lies between poses; the end is extrapolated.
    [(0.0, 0.03), (0.05, 0.03), (0.1, 0.06)],
)
def test_the_pose_is_that_at_the_stamp_wherever_in_the_sweep_it_lies(
    into_sweep_s: float, error_m: float
) -> None:
    """The same sweeps, with stamps at their begin, middle and end."""
    samples = drive('corner', 3, tuple(range(16, 42)), timed=True)
    moved = []
    for sample, after in pairwise(samples):
        cloud = replace(sample.cloud, time_s=sample.cloud.time_s - np.float32(into_sweep_s))
        # The simulator's stamps lie at the begin; the truth in between is on a smooth path.
        share = into_sweep_s / 0.1
        T = se3.interpolate(sample.T_world_lidar, after.T_world_lidar, share)
        moved.append(
            replace(sample, stamp_ns=sample.stamp_ns + round(into_sweep_s * 1e9),
                    cloud=cloud, T_world_lidar=T)
        )  # fmt: skip
    _, estimates = follow(moved)
    skip = 4
    errors = [motion_error(moved, estimates, skip, j) for j in range(skip + 1, len(moved))]
    assert np.abs(errors)[:, :3].max() < error_m  # a sweep's begin and end are up to 0.9 m apart


def test_deskewing_removes_the_distortion() -> None:
    samples = drive('corner', 3, tuple(range(16, 42)), timed=True)
    end = {}
    for deskew in (True, False):
        _, estimates = follow(samples, deskew=deskew)
        end[deskew] = np.linalg.norm(motion_error(samples, estimates, 4, len(samples) - 1)[:3])
    assert end[True] < 0.03 and end[True] < 0.3 * end[False]


def test_lost_sweeps_are_bridged_by_the_speed_and_the_stamps() -> None:
    kept = [s for i, s in enumerate(drive('corner', 0, CORNER)) if i not in (8, 9, 10, 15)]
    _, estimates = follow(kept)
    error = motion_error(kept, estimates, 0, len(kept) - 1)
    assert np.linalg.norm(error[:3]) < 0.1 and all(e.healthy for e in estimates)


ONE_THREAD = """
import sys
sys.path.insert(0, sys.argv[1])
from odometry_drives import drive, follow
for estimate in follow(drive('corner', 0, tuple(range(20, 28))), threads=1)[1]:
    parts = [estimate.T_odom_lidar, estimate.covariance, estimate.growth]
    print(*(part.tobytes().hex() for part in parts if part is not None), estimate.fitness)
"""


def test_one_thread_repeats_exactly() -> None:
    """Each in a process of its own: KISS-ICP keeps the first number of threads that it is given."""
    command = [sys.executable, '-c', ONE_THREAD, str(Path(__file__).parent)]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )
    assert len(first.splitlines()) == 8 and first == second


def test_another_number_of_threads_in_the_process_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(kiss_registration, '_asked_threads', [])
    for threads in (1, 1, 2, 2, 1):
        LidarOdometry(OdometryConfig(threads=threads))
    (record,) = caplog.records
    assert record.levelname == 'WARNING'
    assert 'threads = 2 has no effect: KISS-ICP keeps the 1 (0: all)' in record.getMessage()


def test_points_without_coordinates_change_nothing() -> None:
    samples = drive('corner', 0, CORNER)[:3]
    _, plain = follow(samples, threads=1)
    broken = []
    for sample in samples:
        xyz = np.full((2 * len(sample.cloud), 3), np.nan, np.float32)
        xyz[::2] = sample.cloud.xyz
        xyz[1] = np.inf
        broken.append(replace(sample, cloud=PointCloud(xyz)))
    _, with_nan = follow(broken, threads=1)
    # Threads add up in any order.
    np.testing.assert_allclose(with_nan[-1].T_odom_lidar, plain[-1].T_odom_lidar, atol=1e-9)


def test_what_cannot_be_registered_is_refused_and_changes_nothing() -> None:
    samples = drive('corner', 0, CORNER)[:4]
    odometry, _ = follow(samples[:3], threads=1)
    with pytest.raises(DataError, match='order of their stamps'):
        odometry.register(samples[3].cloud, samples[2].stamp_ns)
    for xyz in (np.empty((0, 3), np.float32), np.full((500, 3), np.nan, np.float32)):
        with pytest.raises(DataError, match='needs 100 finite points'):
            odometry.register(PointCloud(xyz), samples[3].stamp_ns)
    after = odometry.register(samples[3].cloud, samples[3].stamp_ns)
    expected = follow(samples, threads=1)[1][-1]
    np.testing.assert_allclose(after.T_odom_lidar, expected.T_odom_lidar, atol=1e-9)


def test_a_first_sweep_that_is_refused_leaves_it_at_the_start() -> None:
    odometry = LidarOdometry(OdometryConfig())
    with pytest.raises(DataError):
        odometry.register(PointCloud(np.zeros((3, 3), np.float32)), 1)
    assert odometry.register(drive('corner', 0, CORNER)[0].cloud, 1).T_previous_this is None


def test_reset_starts_at_the_identity_whatever_the_stamp() -> None:
    samples = drive('corner', 0, CORNER)[:5]
    odometry, _ = follow(samples)
    odometry.reset()
    again = odometry.register(samples[0].cloud, samples[0].stamp_ns)
    np.testing.assert_array_equal(again.T_odom_lidar, np.eye(4))
    assert again.T_previous_this is None


def test_ranges_that_exclude_everything_are_a_mistake() -> None:
    with pytest.raises(ConfigError, match='min_range must be below'):
        LidarOdometry(OdometryConfig(min_range=50.0, max_range=40.0))


def test_an_abrupt_u_turn_is_noticed_and_found() -> None:
    samples = drive('u_turn', 0, tuple(range(270, 296)))
    turned = [np.degrees(abs(se3.yaw(se3.inverse(a.T_world_lidar) @ b.T_world_lidar)))
              for a, b in pairwise(samples)]  # fmt: skip
    assert max(turned) > 60.0  # a step
    odometry, estimates = follow(samples)
    assert all(e.healthy for e in estimates)
    assert odometry.recoveries >= 2
    assert any('search over headings' in e.reason for e in estimates if e.recovered)
    error = motion_error(samples, estimates, 0, len(samples) - 1)
    assert np.linalg.norm(error[:3]) < 0.1 and np.linalg.norm(error[3:]) < 2e-3


def test_a_turn_that_smears_the_sweep_is_told_by_the_covariance() -> None:
    samples = drive('u_turn', 0, tuple(range(270, 300)), timed=True)
    _, estimates = follow(samples)
    assert any(not e.healthy for e in estimates)
    worst = max(np.linalg.norm(motion_error(samples, estimates, j - 1, j)[3:])
                for j in range(1, len(samples)))  # fmt: skip
    assert worst > 0.3  # the poses in the turn are guesses
    assert step_ratios(samples, estimates, skip=5).max() < 6.0  # and say so
    # Afterwards it is where it should be: the map was not spoilt.
    error = motion_error(samples, estimates, 5, len(samples) - 1)
    assert np.linalg.norm(error[:3]) < 0.1 and np.linalg.norm(error[3:]) < 3e-3


def clutter() -> PointCloud:
    return PointCloud(RNG.uniform(-20, 20, (20_000, 3)).astype(np.float32))


def test_a_sweep_that_fits_nowhere_does_not_enter_the_map() -> None:
    samples = drive('corner', 0, CORNER)[:11]
    odometry, estimates = follow(samples[:10])
    before = odometry.local_map()
    blocked = odometry.register(clutter(), samples[9].stamp_ns + STEP_NS // 2)
    assert not blocked.healthy and 'of the points fit the map' in blocked.reason
    np.testing.assert_array_equal(odometry.local_map(), before)
    sigma = np.sqrt(np.diag(blocked.covariance))
    assert sigma[:3].min() >= 0.5 and sigma[5] >= 1.0
    after = odometry.register(samples[10].cloud, samples[10].stamp_ns)
    assert after.healthy
    whole = motion_error(samples, [*estimates, after], 0, 10)
    assert np.linalg.norm(whole[:3]) < 0.1
    # The step began at a guess: only the chain up to before the blocked sweep is known.
    assert np.sqrt(after.covariance[5, 5]) >= 1.0


def test_after_too_many_failures_the_map_starts_anew() -> None:
    samples = drive('corner', 0, CORNER)
    odometry, _ = follow(samples[:8], max_lost=2)
    stamp = samples[7].stamp_ns
    lost = [odometry.register(clutter(), stamp + i) for i in (1000, 2000)]
    assert [e.healthy for e in lost] == [False, False]
    assert odometry.restarts == 1 and 'map starts anew' in lost[-1].reason
    # The clutter is the map now. Once it has failed as often, the street is.
    follow_up = [odometry.register(s.cloud, s.stamp_ns) for s in samples[8:20]]
    assert all(e.healthy for e in follow_up[-6:])
    error = motion_error(samples[8:20], follow_up, 7, 11)
    assert np.linalg.norm(error[:3]) < 0.1
