"""Remember what odometry said about every keyframe."""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.graph_noise import GraphNoise
from lcd_loop_closure.keyframes import Keyframe


class OdometryChain:
    """Keyframes in rows 0, 1, ... with the motion from each row's predecessor.

    Attributes:
        ids, stamps_ns: of the rows.
        T_odom_base: poses by odometry.
        motions: T_previous_this; the identity in row 0.
        covariances: 6x6 of the motions as the graph uses them, body axes, translation first.
    """

    def __init__(self, noise: GraphNoise) -> None:
        self._noise = noise
        self.ids: list[int] = []
        self.stamps_ns: list[int] = []
        self.T_odom_base: list[se3.Array] = []
        self.motions: list[se3.Array] = []
        self.covariances: list[se3.Array] = []
        self._rows: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self.ids)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._rows

    def row(self, keyframe_id: int) -> int:
        """Return the row of a keyframe; an unknown id raises KeyError."""
        return self._rows[keyframe_id]

    def add(self, keyframe: Keyframe, *, new_session: bool) -> int:
        """Append a keyframe; return its row.

        Where ids leave a gap, the motion is taken from T_odom_base, its covariance grows with it.
        A new session has an odometry and a clock of its own: the motion that its first keyframe has
        is taken as it is, and the stamp may be older.

        Raises:
            DataError: the id or stamp does not increase, or a pose is not finite.
        """
        T_previous_this, covariance = keyframe.T_previous_this, keyframe.motion_covariance
        if not (np.isfinite(T_previous_this).all() and np.isfinite(keyframe.T_odom_base).all()):
            raise DataError(f'expected finite poses, got NaN in keyframe {keyframe.id}; dropped')
        late = bool(self.ids) and not new_session and keyframe.stamp_ns <= self.stamps_ns[-1]
        if not self.ids:
            T_previous_this, covariance = np.eye(4), None
        elif late or keyframe.id <= self.ids[-1]:
            raise DataError(
                f'expected a keyframe after {self.ids[-1]} at {self.stamps_ns[-1]} ns, got '
                f'{keyframe.id} at {keyframe.stamp_ns} ns; dropped (was the bag rewound?)'
            )
        elif keyframe.id != self.ids[-1] + 1 and not new_session:
            T_previous_this = se3.inverse(self.T_odom_base[-1]) @ keyframe.T_odom_base
            covariance = None
        covariance = self._noise.odometry(T_previous_this, covariance)
        self.restore(
            keyframe.id, keyframe.stamp_ns, keyframe.T_odom_base, T_previous_this, covariance
        )
        return len(self.ids) - 1

    def restore(
        self,
        keyframe_id: int,
        stamp_ns: int,
        T_odom_base: se3.Array,
        motion: se3.Array,
        covariance: se3.Array,
    ) -> None:
        """Append a row as it was."""
        self._rows[keyframe_id] = len(self.ids)
        self.ids.append(keyframe_id)
        self.stamps_ns.append(stamp_ns)
        self.T_odom_base.append(T_odom_base)
        self.motions.append(motion)
        self.covariances.append(covariance)

    def arrays(
        self,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], se3.Array, se3.Array, se3.Array]:
        """Return copies of ids, stamps, poses, motions and covariances."""
        count = len(self.ids)
        return (
            np.array(self.ids, np.int64),
            np.array(self.stamps_ns, np.int64),
            np.array(self.T_odom_base).reshape(count, 4, 4),
            np.array(self.motions).reshape(count, 4, 4),
            np.array(self.covariances).reshape(count, 6, 6),
        )
