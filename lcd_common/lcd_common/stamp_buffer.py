"""Pair sensor data with odometry by stamp, in bounded memory."""

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from lcd_common import se3

Item = TypeVar('Item')
_JUMP_NS = 1_000_000_000  # streams differ by less, and jumps are longer (StampGuard)


class Unpaired(Enum):
    """Why an item left the buffer without a pose."""

    BUFFER_FULL = 'odometry did not come'
    TOO_OLD = 'older than the odometry'
    GAP = 'gap in the odometry'


@dataclass(frozen=True)
class StampedPose:
    """Odometry at one time: covariance 6x6 in body axes, None when unknown."""

    stamp_ns: int
    T_odom_base: se3.Array
    covariance: se3.Array | None = None


@dataclass(frozen=True)
class Paired(Generic[Item]):
    """An item and the pose at its stamp."""

    item: Item
    pose: StampedPose


class StampBuffer(Generic[Item]):
    """Let items wait for the odometry at their stamp: exact, or interpolated between two poses.

    Items and poses may come in any order between the two streams, but each stream in the order of
    its stamps. What cannot be paired is appended to `unpaired`, for the caller to count and clear.
    """

    def __init__(self, capacity: int, max_gap_ns: int, history: int = 1000) -> None:
        """Make an empty buffer.

        Args:
            capacity: how many items may wait; the oldest is given up.
            max_gap_ns: longest time between two poses to interpolate over.
            history: how many poses are kept for items that come late.
        """
        self._max_gap_ns = max_gap_ns
        self._capacity = capacity
        self._poses: deque[StampedPose] = deque(maxlen=history)
        self._items: deque[tuple[int, Item]] = deque()
        self.unpaired: list[tuple[Item, Unpaired]] = []

    def __len__(self) -> int:
        return len(self._items)

    def add_item(self, stamp_ns: int, item: Item) -> list[Paired[Item]]:
        """Add an item; return what is paired now, in the order of the stamps."""
        self._items.append((stamp_ns, item))
        paired = self._pair()
        while len(self._items) > self._capacity:
            self.unpaired.append((self._items.popleft()[1], Unpaired.BUFFER_FULL))
        return paired

    def add_pose(self, pose: StampedPose) -> list[Paired[Item]]:
        """Add odometry (one that is not newer than the last is ignored); return what is paired."""
        if self._poses and pose.stamp_ns <= self._poses[-1].stamp_ns:
            return []
        self._poses.append(pose)
        return self._pair()

    def clear(self) -> None:
        """Forget all items and poses."""
        self._items.clear()
        self._poses.clear()

    def rewind(self, stamp_ns: int) -> None:
        """Forget what came before the clock jumped back to a stamp.

        The other stream may have jumped already, or will: each is forgotten while it is ahead.
        """
        if self._poses and self._poses[-1].stamp_ns > stamp_ns + _JUMP_NS:
            self._poses.clear()
        if self._items and self._items[-1][0] > stamp_ns + _JUMP_NS:
            self._items.clear()

    def _pair(self) -> list[Paired[Item]]:
        paired = []
        while self._items and self._poses and self._poses[-1].stamp_ns >= self._items[0][0]:
            stamp_ns, item = self._items.popleft()
            pose = self._at(stamp_ns)
            if isinstance(pose, StampedPose):
                paired.append(Paired(item, pose))
            else:
                self.unpaired.append((item, pose))
        return paired

    def _at(self, stamp_ns: int) -> StampedPose | Unpaired:
        right = bisect_left(self._poses, stamp_ns, key=lambda pose: pose.stamp_ns)
        after = self._poses[right]
        if after.stamp_ns == stamp_ns:
            return after
        if right == 0:
            return Unpaired.TOO_OLD
        before = self._poses[right - 1]
        gap = after.stamp_ns - before.stamp_ns
        if gap > self._max_gap_ns:
            return Unpaired.GAP
        share = (stamp_ns - before.stamp_ns) / gap
        T_odom_base = se3.interpolate(before.T_odom_base, after.T_odom_base, share)
        return StampedPose(stamp_ns, T_odom_base, _covariance_at(before, after, share, T_odom_base))


def _covariance_at(
    before: StampedPose, after: StampedPose, share: float, T_odom_base: se3.Array
) -> se3.Array | None:
    """Let the error grow evenly between two poses; None when it did not accumulate between them."""
    if before.covariance is None or after.covariance is None:
        return None
    T_before_after = se3.inverse(before.T_odom_base) @ after.T_odom_base
    added = se3.relative_covariance(before.covariance, T_before_after, after.covariance)
    if added is None:
        return None
    T_before_base = se3.inverse(before.T_odom_base) @ T_odom_base
    return se3.compose_covariance(before.covariance, T_before_base, share * added)
