"""Hold keyframes back until place recognition said whether they can be told apart at all."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from lcd_common.settings import config, setting

Item = TypeVar('Item')
_JUMP_NS = 1_000_000_000  # as StampGuard has it


@config
class PlaceGateConfig:
    """Whether place recognition decides which candidates are tried."""

    use: bool = setting(
        False, 'do not register candidates by descriptor of scans that place_matches rejects'
    )
    wait: float = setting(
        1.0,
        'how long a keyframe waits for its answer, by the stamps of odometry',
        unit='s',
        low=0.0,
    )
    window: float = setting(
        0.3, 'an answer to a scan this near in time is an answer to the keyframe', unit='s', low=0.0
    )


@dataclass(frozen=True)
class PlaceVerdict:
    """What place recognition says of one scan.

    Attributes:
        stamp_ns: of the scan.
        rejected: why the scan is not to be believed; None when it is not rejected.
        false_match_probability: that its best match is wrong, 0..1, calibrated; None when unknown.
    """

    stamp_ns: int
    rejected: str | None = None
    false_match_probability: float | None = None


class PlaceGate(Generic[Item]):
    """Release items in their order, each with the verdict of the scan nearest in time.

    An item is released by the first verdict that is not older than it, or when `time` has passed
    it by the wait; without a verdict within the window it is released with None. So a
    slow, absent or ended place recognition delays the search by the wait, but stops no loop.
    Waiting is counted by stamps: replay gives the same answers on every run. Safe to call from
    several threads.
    """

    def __init__(
        self,
        settings: PlaceGateConfig,
        release: Callable[[Item, PlaceVerdict | None], None],
        capacity: int = 100,
    ) -> None:
        """Start empty; `release(item, verdict)` is called from whichever call releases the item."""
        self.settings, self._release, self._capacity = settings, release, capacity
        self._wait_ns = round(settings.wait * 1e9)
        self._window_ns = round(settings.window * 1e9)
        self._lock = threading.RLock()
        self.clear()

    def __len__(self) -> int:
        return len(self._items)

    def clear(self) -> None:
        """Forget items and verdicts: the stamps start again."""
        with self._lock:
            self._items: deque[tuple[int, Item]] = deque()
            self._verdicts: deque[PlaceVerdict] = deque(maxlen=100)
            self._now_ns: int | None = None

    def hold(self, stamp_ns: int, item: Item) -> None:
        """Let an item wait for its verdict, which may be here already."""
        with self._lock:
            self._items.append((stamp_ns, item))
            self._pass()

    def answer(self, verdict: PlaceVerdict) -> None:
        """Take in a verdict; one much older than the last says that the stamps start again."""
        with self._lock:
            if self._verdicts and verdict.stamp_ns < self._verdicts[-1].stamp_ns - _JUMP_NS:
                self._verdicts.clear()
            self._verdicts.append(verdict)
            self._pass()

    def time(self, stamp_ns: int) -> None:
        """Note that time has come this far."""
        with self._lock:
            self._now_ns = stamp_ns
            self._pass()

    def _pass(self) -> None:
        newest_ns = max((v.stamp_ns for v in self._verdicts), default=None)
        while self._items:
            stamp_ns, item = self._items[0]
            answered = newest_ns is not None and newest_ns >= stamp_ns
            late = self._now_ns is not None and self._now_ns > stamp_ns + self._wait_ns
            if not answered and not late and len(self._items) <= self._capacity:
                return
            self._items.popleft()
            self._release(item, self._nearest(stamp_ns))

    def _nearest(self, stamp_ns: int) -> PlaceVerdict | None:
        verdict = min(self._verdicts, key=lambda v: abs(v.stamp_ns - stamp_ns), default=None)
        if verdict is None or abs(verdict.stamp_ns - stamp_ns) > self._window_ns:
            return None
        return verdict
