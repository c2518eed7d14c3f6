"""Write a nav_msgs/Path as its serialized bytes.

The whole path is published whenever a loop bends it. Building 10,000 PoseStamped objects in Python
takes a quarter of a second; all poses share one frame_id, so their bytes have a fixed stride and
one numpy array holds them. `publisher.publish` takes serialized bytes as it takes messages.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3

# CDR version 1, little endian. Alignment counts from behind these four bytes.
_ENCAPSULATION = b'\x00\x01\x00\x00'
_POSE = 7 * 8  # position x y z, orientation x y z w


def path_bytes(
    T_frame_body: se3.Array, stamps_ns: NDArray[np.int64], stamp_ns: int, frame_id: str
) -> bytes:
    """Return a nav_msgs/Path in CDR.

    Args:
        T_frame_body: poses [N x 4 x 4], metres.
        stamps_ns: [N] stamps of the poses.
        stamp_ns: stamp of the path.
        frame_id: frame of the path and of every pose.
    """
    name = frame_id.encode() + b'\x00'
    header = _time(np.array([stamp_ns])).tobytes() + _length(len(name)) + name
    prefix = header + bytes(-len(header) % 4) + _length(len(T_frame_body))
    if not len(T_frame_body):
        return _ENCAPSULATION + prefix

    pose_header = 12 + len(name)  # stamp, length of the name, name
    padding = -pose_header % 8  # in front of the doubles, when the pose starts at a multiple of 8
    record = np.dtype(
        {
            'names': ['time', 'length', 'name', 'position', 'orientation'],
            'formats': [('<i4', 2), '<u4', f'V{len(name)}', ('<f8', 3), ('<f8', 4)],
            'offsets': [0, 8, 12, pose_header + padding, pose_header + padding + 24],
            'itemsize': pose_header + padding + _POSE,
        }
    )
    # Every pose but the first starts behind a double, at a multiple of 8. The first starts behind
    # the count; it is laid down as the others are, and its header then moved to where it belongs.
    first_doubles = len(prefix) + pose_header
    first_doubles += -first_doubles % 8
    start = first_doubles - pose_header - padding
    data = np.zeros(start + record.itemsize * len(T_frame_body), np.uint8)
    poses = data[start:].view(record)
    poses['time'] = _time(stamps_ns)
    poses['length'] = len(name)
    poses['name'] = np.frombuffer(name, f'V{len(name)}')[0]
    poses['position'] = T_frame_body[:, :3, 3]
    poses['orientation'] = quaternions(T_frame_body[:, :3, :3])
    first_header = data[start : start + pose_header].copy()
    data[start:first_doubles] = 0
    data[: len(prefix)] = np.frombuffer(prefix, np.uint8)
    data[len(prefix) : len(prefix) + pose_header] = first_header
    return _ENCAPSULATION + data.tobytes()


def quaternions(R: se3.Array) -> se3.Array:
    """Return the unit quaternions x y z w [N x 4] of rotation matrices [N x 3 x 3]."""
    # Shepperd's method as in se3.quaternion_from_rotation, for all at once: the outer product
    # 4 q q^T is linear in R, and the row with the largest diagonal loses no digits.
    xx, yy, zz = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    outer = np.empty((len(R), 4, 4))
    outer[:, 0, 0] = 1 + xx - yy - zz
    outer[:, 1, 1] = 1 - xx + yy - zz
    outer[:, 2, 2] = 1 - xx - yy + zz
    outer[:, 3, 3] = 1 + xx + yy + zz
    outer[:, 0, 1] = outer[:, 1, 0] = R[:, 1, 0] + R[:, 0, 1]
    outer[:, 0, 2] = outer[:, 2, 0] = R[:, 0, 2] + R[:, 2, 0]
    outer[:, 1, 2] = outer[:, 2, 1] = R[:, 2, 1] + R[:, 1, 2]
    outer[:, 0, 3] = outer[:, 3, 0] = R[:, 2, 1] - R[:, 1, 2]
    outer[:, 1, 3] = outer[:, 3, 1] = R[:, 0, 2] - R[:, 2, 0]
    outer[:, 2, 3] = outer[:, 3, 2] = R[:, 1, 0] - R[:, 0, 1]
    largest = np.einsum('nii->ni', outer).argmax(axis=1)
    q = outer[np.arange(len(R)), largest]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(q[:, 3:] < 0, -q, q)


def _time(stamps_ns: NDArray[np.int64]) -> NDArray[np.int32]:
    seconds, nanoseconds = np.divmod(np.asarray(stamps_ns, np.int64), 1_000_000_000)
    return np.stack([seconds, nanoseconds], axis=1).astype('<i4')


def _length(count: int) -> bytes:
    return np.array(count, '<u4').tobytes()
