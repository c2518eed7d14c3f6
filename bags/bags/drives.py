"""Open a drive of any format that the suite reads, given its path."""

from collections.abc import Mapping
from pathlib import Path

from bags.kitti_odometry import is_kitti_odometry, open_kitti_odometry
from bags.records import Drive
from bags.rosbag import is_rosbag, open_rosbag
from lcd_common.errors import DataError

FORMATS = ('kitti_odometry', 'rosbag')


def open_drive(
    path: Path,
    *,
    format: str | None = None,
    sequence: str | None = None,
    topics: Mapping[str, str] | None = None,
) -> Drive:
    """Open a drive; its format is recognised from its layout unless it is given."""
    if is_rosbag(path):
        return open_rosbag(path, topics)
    if is_kitti_odometry(path):
        return open_kitti_odometry(path, sequence)
    raise DataError(f'{path}: unknown')
