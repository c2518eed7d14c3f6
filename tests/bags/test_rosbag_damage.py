"""Bags that are cut off or damaged: what is readable is read, and the rest is said."""

from pathlib import Path

import numpy as np
import pytest
from filled_bag import fill, of

from bags.records import LidarScan
from bags.rosbag import open_rosbag
from lcd_common.errors import DataError

START_NS = 1_700_000_000 * 10**9
SECOND = 10**9


def whole_before(path: Path, data: bytes, points_of, count: int) -> int:
    """Count the clouds whose last byte lies before the cut, by looking for their bytes."""
    whole = path.read_bytes()
    return sum(whole.index(points_of(n, 400).tobytes()) + 6400 <= len(data) for n in range(count))


@pytest.mark.parametrize('share', [0.2, 0.5, 0.8, 0.97])
def test_cut_mcap_gives_every_message_before_the_cut(bag, points_of, tmp_path, share, caplog):
    for n in range(40):
        bag.cloud(START_NS + n * 10**8, points_of(n, 400))
    path = bag.write(compress=False) / 'bag.mcap'
    data = path.read_bytes()[: int(share * path.stat().st_size)]
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(data)
    drive = open_rosbag(cut)
    scans = of(LidarScan, drive)
    expected = whole_before(path, data, points_of, 40)
    assert 0 < expected < 40
    assert len(scans) == expected == drive.streams()[0].count
    for n, scan in enumerate(scans):
        assert np.array_equal(scan.cloud.xyz, points_of(n, 400)[:, :3])
    assert drive.skipped == {'bag cut off: the rest of the file': 1}
    assert 'cut.mcap: cut off or damaged at byte' in caplog.text


def test_cut_zstd_mcap_gives_whole_chunks_and_the_beginning_of_the_last(bag, points_of, tmp_path):
    for n in range(400):
        bag.cloud(START_NS + n * 10**8, points_of(n, 1000))  # 16 kB each; chunks of 1 MiB
    path = bag.write() / 'bag.mcap'
    data = path.read_bytes()
    counts = []
    for share in (0.05, 0.5, 0.51, 0.9):
        cut = tmp_path / 'cut.mcap'
        cut.write_bytes(data[: int(share * len(data))])
        scans = of(LidarScan, open_rosbag(cut))
        for n, scan in enumerate(scans):
            assert np.array_equal(scan.cloud.xyz, points_of(n, 1000)[:, :3])
        counts.append(len(scans))
        assert len(scans) > 400 * share - 12  # zstd unpacks by blocks of 128 kB: eight clouds
    assert counts == sorted(counts)


def test_cut_mcap_inside_a_bag_folder_is_recovered(bag, points_of):
    fill(bag, points_of, 30)
    folder = bag.write(compress=False)
    path = folder / 'bag.mcap'
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    drive = open_rosbag(folder)
    assert 10 < len(of(LidarScan, drive)) < 30
    assert drive.mountings[0].child == 'velodyne'
    spans = drive.records(START_NS + 3 * 10**8, START_NS + 5 * 10**8)
    assert sum(isinstance(r, LidarScan) for r in spans) == 3


def test_damaged_chunk_costs_only_itself(bag, points_of):
    for n in range(300):
        bag.cloud(START_NS + n * 10**8, points_of(n, 1000))
    path = bag.write() / 'bag.mcap'
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    drive = open_rosbag(path)
    scans = of(LidarScan, drive)
    assert 200 < len(scans) < 300
    assert scans[0].stamp_ns == START_NS and scans[-1].stamp_ns == START_NS + 299 * 10**8
    assert len({s.stamp_ns for s in scans}) == len(scans)
    assert drive.skipped


def test_sqlite_bag_damaged_in_the_middle_gives_what_comes_before(bag, points_of):
    for n in range(60):
        bag.cloud(START_NS + n * 10**8, points_of(n, 1000))
    path = bag.write('db3') / 'bag.db3'
    data = bytearray(path.read_bytes())
    page = data.index(points_of(40, 1000).tobytes()[8000:8064]) // 4096 * 4096  # not its row
    data[page : page + 8] = b'\xff' * 8
    path.write_bytes(data)
    drive = open_rosbag(path)
    assert len(of(LidarScan, drive)) == 40
    assert drive.skipped == {'damaged bag: the rest of it': 1}


@pytest.mark.parametrize('seed', range(12))
def test_random_damage_ends_in_one_line_or_a_counted_skip(bag, points_of, seed):
    fill(bag, points_of, 8)
    path = bag.write(compress=seed % 2 == 0) / 'bag.mcap'
    rng = np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), 30):
        data[at] = int(rng.integers(256))
    path.write_bytes(data)
    records, failure = [], ''
    try:
        drive = open_rosbag(path)
        records = list(drive.records())
        drive.streams(), drive.truth()
    except DataError as error:
        failure = str(error)
    if failure:
        assert '\n' not in failure and 'bag.mcap' in failure
    else:
        assert drive.skipped or len(records) == 40
        stamps = [r.stamp_ns for r in records]
        assert stamps == sorted(stamps)


def test_damaged_sqlite_bag_is_an_error_with_a_remedy(bag, points_of):
    fill(bag, points_of)
    path = bag.write('db3') / 'bag.db3'
    path.write_bytes(b'SQLite format 3\0' + b'x' * 100)
    with pytest.raises(DataError, match=r'bag\.db3: not readable as a bag.*copy it again'):
        open_rosbag(path)


def test_cut_rosbag1_is_an_error_with_a_remedy(bag1, points_of):
    fill(bag1, points_of)
    path = bag1.write()
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(DataError, match=r'bag\.bag: not readable as a bag'):
        open_rosbag(path)
