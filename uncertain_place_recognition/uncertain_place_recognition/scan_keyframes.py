"""Find the scan that a keyframe was made of."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Generic, TypeVar

from lcd_common import se3

Item = TypeVar('Item')


@dataclass(frozen=True)
class KeyframeStamp:
    """What a scan needs to know of its keyframe."""

    id: int
    stamp_ns: int
    T_odom_base: se3.Array


class ScanKeyframes(Generic[Item]):
    """Pair scans and keyframes of equal stamps, whichever comes first, in bounded memory.

    Most scans never become keyframes and leave without a word; a keyframe that leaves without its
    scan is counted in `lost`.
    """

    def __init__(self, scans: int, keyframes: int = 20) -> None:
        """Make it empty, with room for so many scans and keyframes."""
        self._room = scans, keyframes
        self._scans: OrderedDict[int, Item] = OrderedDict()
        self._keyframes: OrderedDict[int, KeyframeStamp] = OrderedDict()
        self.lost = 0

    def clear(self) -> None:
        """Forget all that waits."""
        self._scans.clear()
        self._keyframes.clear()

    def add_scan(self, stamp_ns: int, scan: Item) -> tuple[Item, KeyframeStamp] | None:
        """Add a scan; return it with its keyframe when that is here."""
        keyframe = self._keyframes.pop(stamp_ns, None)
        if keyframe is not None:
            return scan, keyframe
        self._scans[stamp_ns] = scan
        while len(self._scans) > self._room[0]:
            self._scans.popitem(last=False)
        return None

    def add_keyframe(self, keyframe: KeyframeStamp) -> tuple[Item, KeyframeStamp] | None:
        """Add a keyframe; return it with its scan when that is here."""
        scan = self._scans.pop(keyframe.stamp_ns, None)
        if scan is not None:
            return scan, keyframe
        self._keyframes[keyframe.stamp_ns] = keyframe
        while len(self._keyframes) > self._room[1]:
            self._keyframes.popitem(last=False)
            self.lost += 1
        return None
