"""MulRan in its published layout (no sample is at hand)."""

from pathlib import Path

import numpy as np
import pytest

from bags.mulran import base_from_ouster, open_mulran
from bags.records import GnssFix, ImuSample, LidarScan
from lcd_common.errors import DataError

FIRST_NS = 1_561_000_444_390_857_630
# As KISS-ICP has it, from the data set's calib_base2ouster.txt.
PUBLISHED = np.array(
    [
        [-9.9998295e-01, -5.8398386e-03, -5.2257060e-06, 1.7042000e00],
        [5.8398386e-03, -9.9998295e-01, 1.7758769e-06, -2.1000000e-02],
        [-5.2359878e-06, 1.7453292e-06, 1.0000000e00, 1.8047000e00],
        [0, 0, 0, 1],
    ]
)
# A row of KAIST01's xsens_imu.csv: attitude, Euler angles, rates, accelerations, magnetic field.
IMU = (
    '0.00149022,-0.0107354,-0.74799680,-0.66361379,0.80698882,0.94414453,96.848543,'
    '-0.00144318,0.00047535,-0.00258758,-0.10445132,0.12008539,9.91283416,0.56985,-0.10887,-0.86261'
)
POSE = (
    '-0.5652699981,-0.8248605171,-0.008657748933,352960.9191,0.8248791602,-0.565135918,'
    '-0.01399161292,4026351.581,0.006648324176,-0.01505063568,0.9998646299,18.64625672'
)


def of(kind, drive):
    return [r for r in drive.records() if isinstance(r, kind)]


@pytest.fixture(params=['', 'sensor_data'])
def sequence(request, tmp_path, points_of) -> Path:
    """Write KAIST01 with three sweeps; the sensors' files lie in one of the two usual places."""
    folder = tmp_path / 'KAIST01'
    sensors = folder / request.param
    (sensors / 'Ouster').mkdir(parents=True)
    for n in range(3):
        points = points_of(n)
        points[[4, 9]] = 0.0  # missing returns
        points.tofile(sensors / 'Ouster' / f'{FIRST_NS + n * 98_778_780}.bin')
    stamps = [FIRST_NS + n * 10_000_001 for n in range(5)]
    (sensors / 'xsens_imu.csv').write_text(''.join(f'{s},{IMU}\n' for s in stamps))
    rows = [f'{s},36.38,127.36,{20 + n},1,0,0,0,2,0,0,0,3\n' for n, s in enumerate(stamps[:2])]
    (sensors / 'gps.csv').write_text(''.join(rows))
    (folder / 'global_pose.csv').write_text(''.join(f'{s},{POSE}\n' for s in stamps))
    return folder


def sensors_of(sequence: Path) -> Path:
    return sequence if (sequence / 'Ouster').is_dir() else sequence / 'sensor_data'


def test_stamps_keep_their_nanoseconds(sequence):
    drive = open_mulran(sequence)
    assert [s.stamp_ns for s in of(LidarScan, drive)] == [
        FIRST_NS, FIRST_NS + 98_778_780, FIRST_NS + 2 * 98_778_780,
    ]  # fmt: skip
    assert [s.stamp_ns - FIRST_NS for s in of(ImuSample, drive)] == [
        0, 10_000_001, 20_000_002, 30_000_003, 40_000_004,
    ]  # fmt: skip
    assert not drive.skipped


def test_missing_returns_are_left_out_and_no_time_is_invented(sequence, points_of):
    cloud = of(LidarScan, open_mulran(sequence))[1].cloud
    expected = np.delete(points_of(1), [4, 9], axis=0)
    assert np.array_equal(cloud.xyz, expected[:, :3])
    assert np.array_equal(cloud.intensity, expected[:, 3])
    assert cloud.time_s is None


def test_ouster_sits_where_the_data_set_says(sequence):
    assert base_from_ouster() == pytest.approx(PUBLISHED, abs=2e-6)
    mounting = open_mulran(sequence).mountings[0]
    assert (mounting.parent, mounting.child) == ('base_link', 'lidar')


def test_imu_and_fix_take_the_right_columns(sequence):
    drive = open_mulran(sequence)
    sample, fix = of(ImuSample, drive)[0], of(GnssFix, drive)[1]
    assert sample.angular_velocity.tolist() == [-0.00144318, 0.00047535, -0.00258758]
    assert sample.linear_acceleration.tolist() == [-0.10445132, 0.12008539, 9.91283416]
    assert (fix.latitude_deg, fix.longitude_deg, fix.altitude_m) == (36.38, 127.36, 21.0)
    assert np.array_equal(fix.covariance_enu, np.diag([1.0, 2.0, 3.0]))


def test_truth_is_the_pose_of_the_base(sequence):
    truth = open_mulran(sequence).truth()
    assert len(truth) == 5
    assert truth.positions[0].tolist() == [352960.9191, 4026351.581, 18.64625672]


def test_broken_rows_are_counted(sequence):
    sensors = sensors_of(sequence)
    with (sensors / 'xsens_imu.csv').open('a') as file:
        file.write(f'{FIRST_NS},1,2,3\nnonsense\n\n')
    with (sensors / 'gps.csv').open('a') as file:
        file.write(f'{FIRST_NS + 5},nan' + ',1' * 11 + '\n')
    drive = open_mulran(sequence)
    assert len(of(ImuSample, drive)) == 5 and len(of(GnssFix, drive)) == 2
    assert drive.skipped == {'broken row of xsens_imu.csv': 2, 'broken row of gps.csv': 1}


def test_repeated_and_backward_rows_are_mended(sequence):
    path = sensors_of(sequence) / 'xsens_imu.csv'
    rows = path.read_text().splitlines()
    path.write_text('\n'.join([rows[2], rows[0], rows[0], rows[1]]))
    drive = open_mulran(sequence)
    assert [s.stamp_ns - FIRST_NS for s in of(ImuSample, drive)] == [0, 10_000_001, 20_000_002]
    assert drive.skipped == {'duplicate stamp': 1}


def test_half_sweep_is_counted(sequence):
    last = max((sensors_of(sequence) / 'Ouster').iterdir())
    last.write_bytes(last.read_bytes()[:33])
    drive = open_mulran(sequence)
    assert len(of(LidarScan, drive)) == 2
    assert drive.skipped == {'scan file of odd size': 1}


def test_sweeps_alone_make_a_drive(sequence):
    (sequence / 'global_pose.csv').unlink()
    for name in ('gps.csv', 'xsens_imu.csv'):
        (sensors_of(sequence) / name).unlink()
    drive = open_mulran(sequence)
    assert drive.truth() is None
    assert len(list(drive.records())) == 3


def test_no_sweeps_is_an_error(sequence):
    for path in (sensors_of(sequence) / 'Ouster').iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r'Ouster: no scans STAMP\.bin'):
        open_mulran(sequence)
