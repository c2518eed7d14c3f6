"""Ask a sweep which points of the map it saw through: what was there has moved."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lcd_common import se3

Floats = NDArray[np.float32]
_STEP_RAD = np.deg2rad(0.8)
_ROWS, _COLUMNS = 100, 450  # 80 degrees from -50 to 30, and all around
_LOWEST_RAD = np.deg2rad(-50.0)
_MARGIN_M, _MARGIN_SHARE = 0.5, 0.03


@dataclass(frozen=True)
class Sight:
    """The nearest range in each direction of a sweep.

    Attributes:
        T_sensor_map: takes the map's points to the sensor.
        range_m: [100 x 450], infinity where nothing came back.
    """

    T_sensor_map: se3.Array
    range_m: Floats


def sight_of(xyz: Floats, T_map_sensor: se3.Array) -> Sight:
    """Return what a sweep [N x 3], sensor frame, says of the space around it.

    The least range of a direction and its neighbours counts: at a grazing angle the ground's own
    range changes much from row to row, and it must not be seen through.
    """
    image = np.full((_ROWS + 2, _COLUMNS + 2), np.inf, np.float32)
    _fill(np.ascontiguousarray(xyz, np.float32), image)
    image[:, 0], image[:, -1] = image[:, -2], image[:, 1]
    filled = np.isfinite(image[1:-1, 1:-1])
    least = image[1:-1, 1:-1].copy()
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            part = image[down : down + _ROWS, right : right + _COLUMNS]
            least = np.minimum(least, part)
    least[~filled] = np.inf
    return Sight(se3.inverse(T_map_sensor), least)


def seen_through(points: Floats, sight: Sight, max_range: float) -> NDArray[np.bool_]:
    """Tell which points [N x 3], map frame, a sweep looked through.

    A direction from which nothing came back says nothing.
    """
    through = np.zeros(len(points), np.bool_)
    T = np.ascontiguousarray(sight.T_sensor_map[:3], np.float64)
    _look(np.ascontiguousarray(points), T, sight.range_m, max_range, through)
    return through


@njit(cache=True, nogil=True, error_model='numpy')
def _cell(x: float, y: float, z: float, range_m: float) -> tuple[int, int]:
    row = int(np.floor((np.arcsin(z / range_m) - _LOWEST_RAD) / _STEP_RAD))
    column = int(np.floor((np.arctan2(y, x) + np.pi) / _STEP_RAD)) % _COLUMNS
    return row, column


@njit(cache=True, nogil=True, error_model='numpy')
def _fill(xyz: Floats, image: Floats) -> None:
    for i in range(len(xyz)):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        range_m = np.sqrt(x * x + y * y + z * z)
        if not range_m > 0.1:
            continue
        row, column = _cell(x, y, z, range_m)
        if 0 <= row < _ROWS and range_m < image[row + 1, column + 1]:
            image[row + 1, column + 1] = range_m


@njit(cache=True, nogil=True, error_model='numpy')
def _look(
    points: Floats, T: se3.Array, image: Floats, max_range: float, through: NDArray[np.bool_]
) -> None:
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        range_m = np.sqrt(x * x + y * y + z * z)
        if range_m > max_range or not range_m > 0.1:
            continue
        row, column = _cell(x, y, z, range_m)
        if 0 <= row < _ROWS:
            seen = image[row, column]
            if seen < np.inf and seen > range_m + _MARGIN_M + _MARGIN_SHARE * range_m:
                through[i] = True
