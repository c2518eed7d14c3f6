"""Watch the stamps of one stream, so that repeated and backward ones are told apart."""

from enum import Enum


class StampVerdict(Enum):
    """What a new stamp is, seen from the stamps before it."""

    NEW = 'new'
    DUPLICATE = 'duplicate'
    LATE = 'late'
    JUMPED_BACK = 'jumped back'


class StampGuard:
    """Classify the stamps of one stream.

    A stamp at most `tolerance_ns` older than the newest is a late message; an older one means that
    the clock jumped back (a looped bag, a restarted simulation).
    """

    def __init__(self, tolerance_ns: int = 1_000_000_000) -> None:
        self.tolerance_ns = tolerance_ns
        self.newest_ns: int | None = None

    def check(self, stamp_ns: int) -> StampVerdict:
        """Classify a stamp and remember it when it is new."""
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.newest_ns = stamp_ns
            return StampVerdict.NEW
        if stamp_ns == self.newest_ns:
            return StampVerdict.DUPLICATE
        if self.newest_ns - stamp_ns <= self.tolerance_ns:
            return StampVerdict.LATE
        return StampVerdict.JUMPED_BACK

    def reset(self) -> None:
        """Forget every stamp."""
        self.newest_ns = None
