"""Open a drive of any format that the suite reads, given its path."""

from collections.abc import Callable, Mapping
from pathlib import Path

from bags.argoverse2 import is_argoverse2, open_argoverse2
from bags.kitti_360 import is_kitti_360, open_kitti_360
from bags.kitti_odometry import is_kitti_odometry, open_kitti_odometry
from bags.kitti_raw import is_kitti_raw, open_kitti_raw
from bags.mulran import is_mulran, open_mulran
from bags.records import Drive
from bags.rosbag import is_rosbag, open_rosbag
from lcd_common.errors import DataError

# The formats in the order in which a folder is tried, and what each is recognised by.
FORMATS: dict[str, str] = {
    'rosbag': 'a .mcap, .db3 or .bag file, or a folder with one or with metadata.yaml',
    'argoverse2': 'a folder with sensors/lidar',
    'mulran': 'a folder with Ouster or sensor_data/Ouster',
    'kitti_360': 'a folder with data_3d_raw, or with velodyne and calibration',
    'kitti_raw': 'a folder with velodyne_points, or with *_drive_*_sync or _extract folders',
    'kitti_odometry': 'a folder with velodyne, or with sequences',
}
_RECOGNISE: dict[str, Callable[[Path], bool]] = {
    'rosbag': is_rosbag,
    'argoverse2': is_argoverse2,
    'mulran': is_mulran,
    'kitti_360': is_kitti_360,
    'kitti_raw': is_kitti_raw,
    'kitti_odometry': is_kitti_odometry,
}
_WITH_SEQUENCES: dict[str, Callable[[Path, str | None], Drive]] = {
    'kitti_360': open_kitti_360,
    'kitti_raw': open_kitti_raw,
    'kitti_odometry': open_kitti_odometry,
}


def open_drive(
    path: Path,
    *,
    format: str | None = None,
    sequence: str | None = None,
    topics: Mapping[str, str] | None = None,
) -> Drive:
    """Open a drive.

    Args:
        path: a bag, or a folder of a data set (its root or one sequence).
        format: one of FORMATS; recognised from the layout when None.
        sequence: which sequence of a root that holds several, e.g. '00'.
        topics: of a bag, which topic to read as what: {'points': '/velodyne_points', 'imu': ''}.

    Raises:
        DataError: there is nothing at the path, no format fits, or the drive cannot be read.
    """
    if not path.exists():
        raise DataError(f'{path}: nothing there; check the path')
    name = recognise(path) if format is None else format
    if name not in FORMATS:
        raise DataError(f'unknown format {name!r}; known are {", ".join(FORMATS)}')
    if topics and name != 'rosbag':
        raise DataError(f'{path}: topics can be chosen in a bag only; this is {name}')
    if name == 'rosbag':
        return open_rosbag(path, topics)
    if name in _WITH_SEQUENCES:
        return _WITH_SEQUENCES[name](path, sequence)
    if sequence is not None and path.name != sequence:
        path = path / sequence
    return open_mulran(path) if name == 'mulran' else open_argoverse2(path)


def recognise(path: Path) -> str:
    """Return the format of a drive; raises DataError saying what was looked for when none fits."""
    for name, fits in _RECOGNISE.items():
        if fits(path):
            return name
    looked_for = '; '.join(f'{name}: {meaning}' for name, meaning in FORMATS.items())
    raise DataError(f'{path}: no known drive. Looked for {looked_for}')
