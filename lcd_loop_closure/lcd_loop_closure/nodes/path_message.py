"""Write a nav_msgs/Path as its serialized bytes.

The whole path is published whenever a loop bends it. Building 10,000 PoseStamped objects in Python
takes a quarter of a second; all poses share one frame_id, so their bytes have a fixed stride and
one numpy array holds them. It is kept from one path to the next, as most poses stay where they are.
`publisher.publish` takes serialized bytes as it takes messages.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3

# CDR version 1, little endian. Alignment counts from behind these four bytes.
_ENCAPSULATION = b'\x00\x01\x00\x00'
_POSE = 7 * 8  # position x y z, orientation x y z w


class PathWriter:
    """Write one path after another, each time only the poses that changed."""

    def __init__(self, frame_id: str) -> None:
        """Start with no pose; `frame_id` is the frame of the path and of every pose."""
        self._name = name = frame_id.encode() + b'\x00'
        header = 12 + len(name)  # stamp, length of the name, name
        padding = -header % 8  # in front of the doubles, when the pose starts at a multiple of 8
        self._record = np.dtype(
            {
                'names': ['time', 'length', 'name', 'position', 'orientation'],
                'formats': [('<i4', 2), '<u4', f'V{len(name)}', ('<f8', 3), ('<f8', 4)],
                'offsets': [0, 8, 12, header + padding, header + padding + 24],
                'itemsize': header + padding + _POSE,
            }
        )
        # Every pose but the first starts behind a double, at a multiple of 8. The first starts
        # behind the count; it is laid down as the others are, and all in front of its doubles is
        # then written over with what belongs there.
        prefix = header + -header % 4 + 4
        self._doubles = prefix + header + -(prefix + header) % 8 + len(_ENCAPSULATION)
        self._start = self._doubles - header - padding
        self._T = np.empty((0, 4, 4))
        self._stamps_ns = np.empty(0, np.int64)
        self._reserve(0)

    def write(self, T_frame_body: se3.Array, stamps_ns: NDArray[np.int64], stamp_ns: int) -> bytes:
        """Return the path in CDR.

        Args:
            T_frame_body: poses [N x 4 x 4], metres; not to be written to until the next call.
            stamps_ns: [N] stamps of the poses; neither.
            stamp_ns: stamp of the path.
        """
        count = len(T_frame_body)
        header = self._header(stamp_ns)
        head = _ENCAPSULATION + header + bytes(-len(header) % 4) + _length(count)
        if not count:
            return head
        if count > len(self._poses):
            self._reserve(2 * count)
        rows = self._changed(T_frame_body, stamps_ns)
        self._T, self._stamps_ns = T_frame_body, stamps_ns
        T = T_frame_body[rows]
        self._poses['time'][rows] = _time(stamps_ns[rows])
        self._poses['position'][rows] = T[:, :3, 3]
        self._poses['orientation'][rows] = quaternions(T[:, :3, :3])
        head = (head + self._header(int(stamps_ns[0]))).ljust(self._doubles, b'\x00')
        self._data[: len(head)] = np.frombuffer(head, np.uint8)
        return self._data[: self._start + self._record.itemsize * count].tobytes()

    def _changed(self, T: se3.Array, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows that are not yet in the array as they are now."""
        known = min(len(self._T), len(T))
        changed = np.ones(len(T), bool)
        if known:
            changed[:known] = (T[:known] != self._T[:known]).reshape(known, 16).any(axis=1)
            changed[:known] |= stamps_ns[:known] != self._stamps_ns[:known]
        return np.nonzero(changed)[0]

    def _reserve(self, count: int) -> None:
        """Make room for so many poses, all of them to be written anew."""
        self._data = np.zeros(self._start + self._record.itemsize * count, np.uint8)
        self._poses = self._data[self._start :].view(self._record)
        self._poses['length'] = len(self._name)
        self._poses['name'] = np.frombuffer(self._name, f'V{len(self._name)}')[0]
        self._T, self._stamps_ns = self._T[:0], self._stamps_ns[:0]

    def _header(self, stamp_ns: int) -> bytes:
        return _time(np.array([stamp_ns])).tobytes() + _length(len(self._name)) + self._name


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
