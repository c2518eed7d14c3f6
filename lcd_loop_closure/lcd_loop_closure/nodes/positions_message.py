"""Carry the positions of all keyframes in one PointCloud2."""

import numpy as np
from sensor_msgs.msg import PointCloud2

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes.messages import points_message
from lcd_common.point_fields import structured
from lcd_loop_closure.radius_search import GraphPositions

_UINT32, _FLOAT32 = 6, 7
_FIELDS = [('x', 0, _FLOAT32), ('y', 4, _FLOAT32), ('z', 8, _FLOAT32), ('id', 12, _UINT32)]
_DTYPE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('id', '<u4')])


def positions_message(
    ids: np.ndarray, T_map_base: se3.Array, stamp_ns: int, frame_id: str
) -> PointCloud2:
    """Make the message: fields x y z (float32, metres, map frame) and id (uint32)."""
    points = np.empty(len(ids), _DTYPE)
    points['id'] = ids
    for column, axis in enumerate('xyz'):
        points[axis] = T_map_base[:, column, 3]
    return points_message(points, _FIELDS, stamp_ns, frame_id)


def positions_from_message(message: PointCloud2) -> GraphPositions:
    """Read the message; raises DataError when a field is missing or a position is not finite."""
    points = structured(message)
    missing = [n for n in ('id', 'x', 'y', 'z') if n not in (points.dtype.names or ())]
    if missing:
        raise DataError(f'graph/keyframes must have the fields id x y z, {missing[0]} is missing')
    xyz = np.stack([points[axis] for axis in 'xyz'], axis=1).astype(np.float64)
    if not np.isfinite(xyz).all():
        raise DataError('graph/keyframes holds a position that is not finite')
    return GraphPositions(points['id'].astype(np.int64), xyz)
