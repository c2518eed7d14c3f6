"""Recognising a drive's format from its layout."""

import pytest

from bags.drives import FORMATS, open_drive, recognise
from lcd_common.errors import DataError


@pytest.mark.parametrize(
    ('folders', 'expected'),
    [
        (['velodyne'], 'kitti_odometry'),
        (['sequences/00/velodyne'], 'kitti_odometry'),
        (['velodyne', 'calibration'], 'kitti_360'),
        (['data_3d_raw/2013_05_28_drive_0003_sync/velodyne_points'], 'kitti_360'),
        (['velodyne_points', 'oxts'], 'kitti_raw'),
        (['2011_09_26_drive_0001_sync/velodyne_points'], 'kitti_raw'),
        (['2011_09_26_drive_0001_extract/velodyne_points'], 'kitti_raw'),
        (['Ouster'], 'mulran'),
        (['sensor_data/Ouster'], 'mulran'),
        (['sensors/lidar'], 'argoverse2'),
    ],
)
def test_layouts_are_told_apart(tmp_path, folders, expected):
    for folder in folders:
        (tmp_path / folder).mkdir(parents=True)
    assert recognise(tmp_path) == expected


def test_kitti_360_sequence_folder_is_not_taken_for_kitti_raw(tmp_path):
    folder = tmp_path / 'data_3d_raw' / '2013_05_28_drive_0003_sync'
    (folder / 'velodyne_points').mkdir(parents=True)
    assert recognise(folder) == 'kitti_360'


@pytest.mark.parametrize('name', ['a.mcap', 'a.db3', 'a.bag'])
def test_bag_files_are_recognised(tmp_path, name):
    (tmp_path / name).touch()
    assert recognise(tmp_path / name) == 'rosbag'
    if not name.endswith('.bag'):
        assert recognise(tmp_path) == 'rosbag'


def test_unknown_layout_is_an_error_that_lists_what_was_looked_for(tmp_path):
    with pytest.raises(DataError, match=r'no known drive\. Looked for') as error:
        open_drive(tmp_path)
    assert all(name in str(error.value) for name in FORMATS)
    assert '\n' not in str(error.value)


def test_nothing_at_the_path_is_an_error(tmp_path):
    with pytest.raises(DataError, match='nothing there'):
        open_drive(tmp_path / 'absent')


def test_format_sequence_and_topics_are_handed_on(kitti, bag, points_of, tmp_path):
    kitti(sequence='05')
    kitti(sequence='07')
    assert open_drive(tmp_path, sequence='07').name == 'kitti_odometry_07'
    assert open_drive(tmp_path, format='kitti_odometry', sequence='05').path.name == '05'
    bag.cloud(10**18, points_of(0), topic='/a')
    bag.cloud(10**18, points_of(1), topic='/b')
    path = bag.write()
    assert open_drive(path, topics={'points': '/b'}).streams()[0].topic == '/b'


def test_wrong_format_and_topics_for_folders_are_errors(kitti):
    folder = kitti()
    with pytest.raises(DataError, match=r"unknown format 'kity'; known are rosbag"):
        open_drive(folder, format='kity')
    with pytest.raises(DataError, match='topics can be chosen in a bag only'):
        open_drive(folder, topics={'points': '/a'})
    with pytest.raises(DataError, match=r'no sweeps STAMP\.feather'):
        open_drive(folder, format='argoverse2')
