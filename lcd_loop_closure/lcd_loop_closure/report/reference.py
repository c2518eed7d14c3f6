"""Read a reference trajectory that is not part of a drive, and move it to base_link."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.records import Mounting
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory, read_poses, read_tum

# No drive was recorded in January 1970: smaller times count from the drive's beginning.
_EARLIEST_NS = 1_000_000 * 1_000_000_000


@dataclass(frozen=True)
class Reference:
    """Poses of some frame, with or without times.

    Attributes:
        path: where they were read, for messages.
        T_world_body: [N x 4 x 4].
        stamps_ns: [N] as in the file; None when the file has one pose per scan and no times.
    """

    path: Path
    T_world_body: se3.Array
    stamps_ns: NDArray[np.int64] | None

    def trajectory(self, scan_stamps_ns: NDArray[np.int64], T_body_base: se3.Array) -> Trajectory:
        """Return T_world_base.

        Args:
            scan_stamps_ns: of all scans of the drive: times for poses without, and the beginning
                that times since zero count from.
            T_body_base: base_link in the frame whose poses these are.

        Raises:
            DataError: poses without times are not as many as the scans, or times do not increase.
        """
        stamps = self.stamps_ns
        if stamps is None:
            if len(scan_stamps_ns) != len(self.T_world_body):
                raise DataError(
                    f'{self.path}: expected a pose for each of the {len(scan_stamps_ns)} scans, '
                    f'got {len(self.T_world_body)}; drive the whole recording, or give times too'
                )
            stamps = scan_stamps_ns
        elif len(stamps) and len(scan_stamps_ns) and stamps[0] < _EARLIEST_NS <= scan_stamps_ns[0]:
            stamps = stamps + scan_stamps_ns[0]
        try:
            return Trajectory(stamps, self.T_world_body).in_frame(np.eye(4), T_body_base)
        except DataError as error:
            raise DataError(f'{self.path}: {error}') from None


def read_reference(path: Path) -> Reference:
    """Read a TUM file (8 numbers a row) or a KITTI poses file (12, or 13 with a time in seconds).

    Raises:
        DataError: the file is neither, or holds no poses.
    """
    try:
        lines = path.read_text().splitlines()
        rows = (line.split('#')[0].replace(',', ' ').split() for line in lines)
        columns = next((len(row) for row in rows if row), 0)
    except UnicodeDecodeError:
        raise DataError(f'{path}: expected a text file of poses, got something binary') from None
    if columns == 0:
        raise DataError(f'{path}: expected a pose in each row, found none')
    if columns == 8:
        tum = read_tum(path)
        return Reference(path, tum.T_world_body, tum.stamps_ns)
    poses, stamps = read_poses(path), None
    if columns == 13:
        seconds = np.loadtxt(path, usecols=0, ndmin=1)
        stamps = np.round(seconds * 1e9).astype(np.int64)
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(bad):
        raise DataError(f'{path}: the pose in row {bad[0] + 1} is not finite; remove the row')
    return Reference(path, poses, stamps)


def mounting_in_base(mountings: Iterable[Mounting], frame: str) -> se3.Array:
    """Return T_base_frame from a drive's mountings.

    Raises:
        DataError: they do not connect the frame with base_link.
    """
    parents = {mounting.child: mounting for mounting in mountings}
    T_base_frame, at = np.eye(4), frame
    for _ in range(len(parents) + 1):
        if at == 'base_link':
            return T_base_frame
        if at not in parents:
            break
        T_base_frame = parents[at].T_parent_child @ T_base_frame
        at = parents[at].parent
    known = ', '.join(['base_link', *parents])
    raise DataError(f'the drive does not say where {frame!r} is mounted; it knows {known}')
