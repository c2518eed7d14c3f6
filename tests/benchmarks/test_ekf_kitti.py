"""Score made-up tracks of the KITTI 00 benchmark where the errors are known."""

import numpy as np
import pytest

from benchmarks import ekf_kitti
from benchmarks.ekf_kitti import GroundTruth, KittiRecording, Outages, Track
from lcd_common import se3
from lcd_common.errors import DataError

SECOND = 1_000_000_000


def test_outages_alternate_and_the_last_is_cut_off():
    outages = Outages(begin_ns=5 * SECOND, on_s=60.0, off_s=60.0)
    stamps = np.array([0, 64, 65, 124, 125, 184, 186]) * SECOND
    assert outages.lost(stamps).tolist() == [False, False, True, True, False, False, True]
    spans = [(a // SECOND, b // SECOND) for a, b in outages.spans(200 * SECOND)]
    assert spans == [(65, 125), (185, 200)]


def test_scores_are_of_horizontal_errors_with_and_without_gps():
    stamps = np.arange(0, 301) * SECOND
    where = np.zeros((301, 3))
    truth = GroundTruth(stamps * 1e-9, where, 0.0, 0.0)
    outages = Outages(0)
    lost = outages.lost(stamps)
    off = np.where(lost, 3.0, 0.5)
    positions = np.stack([off * 0.6, off * 0.8, np.full(301, 50.0)], 1)
    found = ekf_kitti.scores(Track(stamps, positions), truth, outages)
    assert found['with_gps_mean_m'] == pytest.approx(0.5) == found['with_gps_p95_m']
    assert found['outage_mean_m'] == pytest.approx(3.0) == found['outage_max_m']
    # Each outage ends with its last second, where the GPS comes back.
    assert found['outage_end_m'] == pytest.approx([0.5, 0.5])
    late = Track(stamps + SECOND // 2, positions)
    gps = KittiRecording(stamps, where, where, stamps[:10], where[:10])
    np.testing.assert_array_equal(ekf_kitti.at_fixes(late, gps).stamps_ns, late.stamps_ns[:10])


def test_outside_of_the_trajectory_there_is_no_truth():
    truth = GroundTruth(np.array([1.0, 2.0]), np.array([[0.0, 0, 0], [2, 4, 6]]), 0.0, 0.0)
    at = truth.at(np.array([0, SECOND * 3 // 2, 3 * SECOND]))
    np.testing.assert_allclose(at[1], [1, 2, 3])
    assert np.isnan(at[[0, 2]]).all()


def test_the_trajectory_is_laid_onto_the_gps_in_space_and_time(tmp_path):
    """Poses of KITTI's layout, turned, moved and 2.34 s late: the fit finds all of it."""
    times = np.arange(0, 100, 0.1)
    camera = np.stack([20 * np.sin(times / 7), 0.5 * np.sin(times), 30 * np.cos(times / 11)], 1)
    poses = np.concatenate([np.tile(np.eye(3), (len(times), 1, 1)), camera[:, :, None]], 2)
    (tmp_path / 'poses').mkdir()
    (tmp_path / 'sequences' / '00').mkdir(parents=True)
    np.savetxt(tmp_path / 'poses' / '00.txt', poses.reshape(-1, 12))
    np.savetxt(tmp_path / 'sequences' / '00' / 'times.txt', times)
    T = se3.exp([100.0, -50, 3, 0.3, -0.2, 1.0])
    gps_s = np.arange(5.0, 90.0)
    here = np.stack([np.interp(gps_s, times, column) for column in camera.T], 1)
    gps_ns = np.round((gps_s + 2.34) * SECOND).astype(np.int64)
    nothing = np.zeros((0, 3))
    drive = KittiRecording(gps_ns[:0], nothing, nothing, gps_ns, se3.transform_points(T, here))
    truth = ekf_kitti.ground_truth(drive, tmp_path)
    # The sensor sits beside the camera: a constant that the rigid motion takes up.
    assert truth.rms_m < 0.05
    assert truth.times_s[0] == pytest.approx(2.34, abs=0.011)
    np.testing.assert_allclose(truth.at(gps_ns), drive.positions, atol=0.2)
    with pytest.raises(DataError, match='sequence 00'):
        ekf_kitti.ground_truth(drive, tmp_path / 'none')
