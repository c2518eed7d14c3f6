"""Hold a trajectory and write it in the formats that evo, viewers and KITTI's tools read."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError


@dataclass(frozen=True)
class Trajectory:
    """Poses of one body in one frame.

    Attributes:
        stamps_ns: [N] int64 nanoseconds, strictly increasing.
        T_world_body: [N x 4 x 4] float64, metres.
    """

    stamps_ns: NDArray[np.int64]
    T_world_body: se3.Array

    def __post_init__(self) -> None:
        if self.T_world_body.shape != (len(self.stamps_ns), 4, 4):
            raise DataError(
                f'a trajectory of {len(self.stamps_ns)} stamps needs as many 4 x 4 poses, '
                f'got the shape {self.T_world_body.shape}'
            )
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise DataError('the stamps of a trajectory must increase strictly; sort them first')

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> se3.Array:
        """Positions [N x 3], metres."""
        return self.T_world_body[:, :3, 3]

    @property
    def length_m(self) -> float:
        """Path length in metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def at(self, stamp_ns: int, max_gap_ns: int = 1_000_000_000) -> se3.Array | None:
        """Return the interpolated pose, or None outside the trajectory or in too long a gap."""
        if not len(self) or not self.stamps_ns[0] <= stamp_ns <= self.stamps_ns[-1]:
            return None
        right = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if self.stamps_ns[right] == stamp_ns:
            return self.T_world_body[right]
        gap = int(self.stamps_ns[right] - self.stamps_ns[right - 1])
        if gap > max_gap_ns:
            return None
        share = (stamp_ns - int(self.stamps_ns[right - 1])) / gap
        return se3.interpolate(self.T_world_body[right - 1], self.T_world_body[right], share)

    def in_frame(self, T_new_world: se3.Array, T_body_new: se3.Array) -> 'Trajectory':
        """Express the trajectory in another world frame and for another body frame."""
        return Trajectory(self.stamps_ns, T_new_world @ self.T_world_body @ T_body_new)

    def write_tum(self, path: Path) -> None:
        """Write `stamp x y z qx qy qz qw` rows, seconds and metres."""
        with path.open('w') as file:
            for stamp, T in zip(self.stamps_ns, self.T_world_body, strict=True):
                values = [*T[:3, 3], *se3.quaternion_from_rotation(T[:3, :3])]
                seconds, rest = divmod(int(stamp), 1_000_000_000)
                file.write(f'{seconds}.{rest:09d} ' + ' '.join(f'{v:.9f}' for v in values) + '\n')

    def write_kitti(self, path: Path) -> None:
        """Write 3x4 row-major rows, metres."""
        np.savetxt(path, self.T_world_body[:, :3].reshape(len(self), 12), fmt='%.9e')


def read_tum(path: Path) -> Trajectory:
    """Read `stamp x y z qx qy qz qw` rows.

    Raises:
        DataError: a row does not have eight numbers or the stamps do not increase.
    """
    stamps, poses = [], []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        fields = line.split('#')[0].replace(',', ' ').split()
        if not fields:
            continue
        try:
            # Seconds since 1970 with nanoseconds do not fit a float: read them as integers.
            seconds, _, decimals = fields[0].partition('.')
            stamps.append(int(seconds) * 1_000_000_000 + int((decimals + '0' * 9)[:9]))
            values = [float(v) for v in fields[1:]]
            if len(values) != 7:
                raise ValueError
            poses.append(se3.from_xyz_quaternion(values[:3], values[3:]))
        except ValueError:
            raise DataError(
                f'{path}:{number}: expected "stamp x y z qx qy qz qw", got {line!r}'
            ) from None
    return Trajectory(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4))


def read_poses(path: Path) -> se3.Array:
    """Read a poses file [N x 4 x 4]: KITTI rows of 12 numbers, or 13 with a leading timestamp.

    Raises:
        DataError: a row has another count of numbers or holds something else.
    """
    try:
        rows = np.loadtxt(path, ndmin=2)
    except OSError:
        raise DataError(f'{path}: expected a poses file, found none; check the path') from None
    except ValueError as error:
        raise DataError(f'{path}: expected 12 (or 13) numbers a row: {error}') from None
    if rows.shape[1] not in (12, 13):
        raise DataError(f'{path}: expected 12 (or 13) numbers a row, got {rows.shape[1]}')
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows[:, -12:].reshape(-1, 3, 4)
    return poses
