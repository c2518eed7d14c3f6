"""Keep new entries back for a while, so that a vehicle does not recognise where it stands.

Delayed insertion needs no filter and no deletion, and so it works with every engine.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.settings import config, setting


@config
class InsertionConfig:
    """How long a new entry is kept back; what asks for more decides."""

    seconds: float = setting(0.0, 'time before an entry is found', unit='s', low=0.0)
    entries: int = setting(0, 'entries that must come after one before it is found', low=0)


@dataclass(frozen=True)
class Entry:
    """A descriptor [length] of a place, and when it was seen."""

    place_id: int
    descriptor: NDArray[np.float32]
    stamp_ns: int | None


class InsertionWindow:
    """First in, first out: entries leave when they are old enough."""

    def __init__(self, settings: InsertionConfig | None = None) -> None:
        self.settings = settings or InsertionConfig()
        self._waiting: deque[Entry] = deque()
        self._now_ns: int | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def waiting(self) -> list[Entry]:
        """Entries that cannot be found yet, oldest first."""
        return list(self._waiting)

    def push(self, entry: Entry) -> list[Entry]:
        """Take in an entry and return those that leave now."""
        if entry.stamp_ns is None:
            return [entry]
        self._waiting.append(entry)
        return self.release(entry.stamp_ns)

    def release(self, stamp_ns: int | None) -> list[Entry]:
        """Return entries that are old enough at `stamp_ns`; None leaves time where it is."""
        # A stamp out of order must not let time run backwards.
        if stamp_ns is not None and (self._now_ns is None or stamp_ns > self._now_ns):
            self._now_ns = stamp_ns
        out = []
        while self._waiting and self._may_leave(self._waiting[0]):
            out.append(self._waiting.popleft())
        return out

    def _may_leave(self, oldest: Entry) -> bool:
        if len(self._waiting) <= self.settings.entries:
            return False
        assert self._now_ns is not None and oldest.stamp_ns is not None
        # In whole nanoseconds: stamps of today have no room for fractions in a double.
        return self._now_ns - oldest.stamp_ns >= round(self.settings.seconds * 1e9)
