"""`bags simulate` and the input town:SEED, as a user types them."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from bags.cli import main
from bags.drives import open_drive
from bags.inputs import open_input
from bags.records import LidarScan
from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig

SHORT = ['simulate', '--town', '3', '--length', '50', '--sensor', 'vlp16', '--quiet']


def contents(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(bytes(data))
    return found


def test_runs_become_bags_and_the_same_seed_the_same_bytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*SHORT, '--runs', '2', '--imu', '--gnss']
    assert main([*arguments, '--out', str(tmp_path / 'a.mcap')]) == 0
    assert main([*SHORT, '--imu', '--out', str(tmp_path / 'again.mcap')]) == 0
    assert {p.name for p in tmp_path.iterdir()} == {'a_run0.mcap', 'a_run1.mcap', 'again.mcap'}
    first, second, again = (
        contents(tmp_path / name) for name in ('a_run0.mcap', 'a_run1.mcap', 'again.mcap')
    )
    assert set(first) == {'/points', '/imu', '/gps/fix', '/ground_truth/pose', '/tf_static'}
    assert set(first) - set(again) == {'/gps/fix'}  # not asked for, not there
    assert all(again[topic] == first[topic] for topic in ('/points', '/imu', '/ground_truth/pose'))
    assert first['/points'][50] != second['/points'][50]
    assert 'town_3_run1' in capsys.readouterr().out


def test_a_kitti_folder_reads_as_it_was_driven(tmp_path: Path) -> None:
    """The repository's own reader of KITTI sequences is the oracle."""
    root = tmp_path / 'kitti'
    assert main([*SHORT, '--format', 'kitti', '--out', str(root)]) == 0
    read = open_drive(root)
    driven = SimulatedDrive(3, 0, JourneyConfig(length=50.0), SensorsConfig(lidar='vlp16'))
    truth = read.truth()
    assert truth is not None
    expected = driven.truth().T_world_body
    from_first = np.linalg.inv(expected[0]) @ expected
    np.testing.assert_allclose(truth.T_world_body, from_first, atol=1e-6)
    scans = list(read.records(kinds=(LidarScan,)))
    sweep = driven.sweep(60)
    assert isinstance(scans[60], LidarScan)
    np.testing.assert_array_equal(scans[60].cloud.xyz, sweep.cloud.xyz)
    labels = np.fromfile(root / 'sequences' / '00' / 'labels' / '000060.label', np.uint32)
    np.testing.assert_array_equal(labels, sweep.label)
    np.testing.assert_array_equal(scans[60].cloud.label, sweep.label)
    np.testing.assert_array_equal(scans[60].cloud.moving, sweep.moving)
    assert main([*SHORT, '--format', 'kitti', '--out', str(root)]) == 1  # exists
    assert not list((root / 'sequences').glob('.*'))


def test_labels_are_in_the_bag_unless_nobody_wants_them(tmp_path: Path) -> None:
    for name, options in (('with', []), ('without', ['--no-labels'])):
        assert main([*SHORT, *options, '--out', str(tmp_path / f'{name}.mcap')]) == 0
    driven = SimulatedDrive(3, 0, JourneyConfig(length=50.0), SensorsConfig(lidar='vlp16', imu=''))
    sweep = driven.sweep(0)
    scan = next(iter(open_drive(tmp_path / 'with.mcap').records(kinds=(LidarScan,))))
    assert isinstance(scan, LidarScan)
    np.testing.assert_array_equal(scan.cloud.label, sweep.label)
    np.testing.assert_array_equal(scan.cloud.moving, sweep.moving)
    scan = next(iter(open_drive(tmp_path / 'without.mcap').records(kinds=(LidarScan,))))
    assert isinstance(scan, LidarScan)
    assert scan.cloud.label is None and len(scan.cloud) == len(sweep.cloud)


def test_blocked_sectors_have_no_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """`--blocked` as a user types it, twice; the drive is not written, one sweep tells."""
    driven: list[SimulatedDrive] = []

    def keep(drive: SimulatedDrive, *_: object, **__: object) -> dict[str, int]:
        driven.append(drive)
        return {}

    monkeypatch.setattr('bags.simulate.convert', keep)
    sectors = ['--blocked', '-45', '45', '--blocked', '145', '215']
    assert main([*SHORT, *sectors, '--out', 'x.mcap']) == 0
    xyz = driven[0].scan(0).cloud.xyz
    azimuth = np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))
    # A beam's own error of azimuth is far below a degree.
    assert np.abs(azimuth).min() > 44.0 and np.abs(azimuth).max() < 146.0
    by_ten_degrees = np.histogram(np.abs(azimuth), np.arange(45.0, 146.0, 10.0))[0]
    assert by_ten_degrees.min() > 200


def test_a_town_is_an_input() -> None:
    named = open_input('town:3:1')
    assert (named.name, open_input('town').name) == ('town_3_run1', 'town_36_run0')
    assert {s.topic for s in named.streams()} >= {'/points', '/imu', '/gps/fix'}


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--town', '-1', '--out', 'x'], 'must be at least 0'),
        (['--runs', '0', '--out', 'x'], '--runs at least 1'),
        (['--length', '5', '--out', 'x'], 'at least 50 m, got 5'),
        (['--reverse', '2', '--out', 'x'], 'at most 0.9'),
        (['--sensor', 'hdl65', '--out', 'x'], 'a lidar is one of'),
        (['--blocked', '0', '360', '--out', 'x'], 'less than 360'),
        (['--blocked', '0', '180', '--blocked', '180', '0', '--out', 'x'], 'nothing to see'),
        (['--blocked', '0', 'nan', '--out', 'x'], 'blocked takes the azimuths'),
        (['--imu', 'xsens', '--out', 'x'], 'an imu is one of'),
        (['--style', 'baroque', '--out', 'x'], 'a style is one of'),
        (['--format', 'kitti', '--imu', '--out', 'x'], 'no place for --imu'),
        (['--out', '/nowhere/x.mcap'], 'does not exist; create it'),
        (['--format', 'kitti', '--out', '/nowhere/x'], 'does not exist; create it'),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(['simulate', *arguments]) == 1
    error = capsys.readouterr().err
    assert error.startswith('error: ') and error.count('\n') == 1 and message in error
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_number_of_a_town_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', 'town:three']) == 1
    assert 'town:SEED or town:SEED:RUN' in capsys.readouterr().err
