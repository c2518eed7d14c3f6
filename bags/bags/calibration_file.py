"""Read KITTI's `name: numbers` calibration files."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError


class CalibrationFile:
    """The matrices of one calibration file, by name."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            DataError: there is none.
        """
        self.path = path
        self._values: dict[str, str] = {}
        try:
            text = path.read_text(errors='replace')
        except OSError as error:
            raise DataError(f'{path}: calibration file expected: {error.strerror}') from None
        for line in text.splitlines():
            name, colon, values = line.partition(':')
            if colon:
                self._values[name.strip()] = values.strip()

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def matrix(self, name: str, rows: int, columns: int) -> NDArray[np.float64]:
        """Return a matrix, row by row.

        Raises:
            DataError: the name is missing, or has another count of numbers.
        """
        if name not in self._values:
            known = ', '.join(self._values) or 'nothing'
            raise DataError(f'{self.path}: the entry {name} is missing; it has {known}')
        try:
            values = np.array(self._values[name].split(), np.float64)
        except ValueError:
            values = np.empty(0)
        if values.size != rows * columns or not np.isfinite(values).all():
            raise DataError(
                f'{self.path}: {name} must be {rows * columns} numbers, got {self._values[name]!r}'
            )
        return values.reshape(rows, columns)

    def transform(self, name: str) -> se3.Array:
        """Return a 4x4 transform from twelve numbers (3x4)."""
        values = self.matrix(name, 3, 4)
        return rigid(values[:, :3], values[:, 3], f'{self.path}: {name}')

    def rotation_translation(self, suffix: str = '') -> se3.Array:
        """Return the 4x4 transform of two entries R and T, as KITTI's raw recordings have them."""
        R, t = self.matrix(f'R{suffix}', 3, 3), self.matrix(f'T{suffix}', 3, 1)
        return rigid(R, t[:, 0], f'{self.path}: R{suffix}')

    def rotation(self, name: str) -> NDArray[np.float64]:
        """Return a 3x3 rotation matrix."""
        return rigid(self.matrix(name, 3, 3), np.zeros(3), f'{self.path}: {name}')[:3, :3]


def rigid(R: NDArray[np.float64], t: NDArray[np.float64], source: str) -> se3.Array:
    """Assemble a transform; the rotation's rounding is removed.

    Raises:
        DataError: R is no rotation (further than 1e-3 from one).
    """
    u, _, vt = np.linalg.svd(R)
    nearest = u @ vt
    if np.abs(nearest - R).max() > 1e-3 or np.linalg.det(nearest) < 0:
        raise DataError(f'{source}: a rotation is expected in the first three columns')
    return se3.from_rotation_translation(nearest, t)
