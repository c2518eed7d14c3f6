"""Read and lay out the bytes of a sensor_msgs/PointCloud2 without importing ROS.

rclpy, rosbags and mcap each have a PointCloud2 class of their own; all have the same attributes,
and only these are used here.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError

# sensor_msgs/PointField constants.
_DTYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_CODES = {'i1': 1, 'u1': 2, 'i2': 3, 'u2': 4, 'i4': 5, 'u4': 6, 'f4': 7, 'f8': 8}

# Names drivers give to point time. Integer times are nanoseconds (Ouster `t`, Livox `offset_time`);
# floating ones are seconds (Velodyne `time`, Hesai `timestamp`), unless they cannot be.
TIME_FIELDS = ('t', 'time', 'timestamp', 'offset_time', 'time_offset', 'timeStamp', 'time_stamp')
LABEL_FIELD = 'label'  # whole numbers; SemanticKITTI's class is in the lower 16 bits
INTENSITY_FIELDS = ('intensity', 'reflectivity', 'i', 'reflectance')
_LONGEST_SWEEP_S = 1.0


def structured(message: Any) -> NDArray[np.void]:
    """Return the points of a PointCloud2-like message as a structured array view [N].

    Raises:
        DataError: the layout is impossible, or the data is shorter than it promises.
    """
    names = [field.name for field in message.fields]
    try:
        order = '>' if message.is_bigendian else '<'
        dtype = np.dtype(
            {
                'names': names,
                'formats': [order + _DTYPES[field.datatype] for field in message.fields],
                'offsets': [field.offset for field in message.fields],
                'itemsize': message.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        raise DataError(
            f'PointCloud2 has an impossible layout of fields {names}: {error}'
        ) from None
    data = np.frombuffer(message.data, np.uint8)
    used = message.width * message.point_step
    row_step = message.row_step if message.height > 1 else used
    needed = message.height * row_step
    if row_step < used or len(data) < needed:
        raise DataError(
            f'PointCloud2 promises {message.height} rows of {message.width} points of '
            f'{message.point_step} bytes, got {len(data)} bytes with row_step {message.row_step}'
        )
    if message.width == 0 or message.height == 0:
        return np.empty(0, dtype)
    if row_step == used:
        return data[:needed].view(dtype)
    rows = data[:needed].reshape(message.height, row_step)[:, :used]
    return np.ascontiguousarray(rows).reshape(-1).view(dtype)


def cloud_from_fields(message: Any, stamp_ns: int) -> PointCloud:
    """Read a PointCloud2-like message.

    Args:
        message: any object with the attributes of sensor_msgs/PointCloud2.
        stamp_ns: the header's stamp, to make absolute point times relative.

    Raises:
        DataError: x, y or z is missing, or the layout is impossible.
    """
    points = structured(message)
    names = points.dtype.names or ()
    missing = [axis for axis in 'xyz' if axis not in names]
    if missing:
        raise DataError(
            f'PointCloud2 must have the fields x, y and z; it has {", ".join(names) or "none"}'
        )
    xyz = np.empty((len(points), 3), np.float32)
    for column, axis in enumerate('xyz'):
        xyz[:, column] = points[axis]
    intensity = next((points[n].astype(np.float32) for n in INTENSITY_FIELDS if n in names), None)
    time_s = next((_relative_time(points[n], stamp_ns) for n in TIME_FIELDS if n in names), None)
    label = None
    if LABEL_FIELD in names and points[LABEL_FIELD].dtype.kind in 'iu':
        label = (points[LABEL_FIELD] & 0xFFFF).astype(np.uint16)
    return PointCloud(xyz, intensity, time_s, label)


def _relative_time(values: NDArray[np.generic], stamp_ns: int) -> NDArray[np.float32] | None:
    """Return seconds relative to the stamp, or None when all points carry the same time."""
    if len(values) == 0 or values.min() == values.max():
        return None
    if values.dtype.kind in 'iu':
        nanoseconds = values.astype(np.int64)
        if int(nanoseconds.max()) > stamp_ns // 2 > 0:  # absolute
            nanoseconds = nanoseconds - stamp_ns
        seconds = nanoseconds * 1e-9
    else:
        seconds = values.astype(np.float64)
        if float(seconds.max()) > 1e15:  # absolute nanoseconds in a float
            seconds = seconds * 1e-9
        if float(seconds.max()) > 1e8:  # absolute seconds since 1970
            seconds = seconds - stamp_ns * 1e-9
        elif float(np.ptp(seconds)) > _LONGEST_SWEEP_S:
            # No sweep lasts so long: some drivers write microseconds or nanoseconds as floats.
            seconds = seconds * (1e-9 if float(np.ptp(seconds)) > 1e6 else 1e-6)
    return seconds.astype(np.float32)


def layout(cloud: PointCloud) -> tuple[NDArray[np.void], list[tuple[str, int, int]]]:
    """Lay a cloud out as PointCloud2 bytes.

    Returns:
        The structured array [N] (x y z, then intensity and time where known, all float32, time in
        seconds after the stamp; then label as uint32) and its fields as (name, offset, datatype).
    """
    columns: list[tuple[str, NDArray[Any]]] = [
        ('x', cloud.xyz[:, 0]),
        ('y', cloud.xyz[:, 1]),
        ('z', cloud.xyz[:, 2]),
    ]
    if cloud.intensity is not None:
        columns.append(('intensity', cloud.intensity))
    if cloud.time_s is not None:
        columns.append(('time', cloud.time_s))
    if cloud.label is not None:
        columns.append((LABEL_FIELD, cloud.label))
    # Four bytes each, labels too: floats that are not aligned are slow to read.
    types = ['u4' if name == LABEL_FIELD else 'f4' for name, _ in columns]
    points = np.empty(
        len(cloud), [(name, f'<{of}') for (name, _), of in zip(columns, types, strict=True)]
    )
    for name, values in columns:
        points[name] = values
    fields = [
        (name, 4 * number, _CODES[of])
        for number, ((name, _), of) in enumerate(zip(columns, types, strict=True))
    ]
    return points, fields
