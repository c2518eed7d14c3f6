"""Tell when a recorded moment is due, with a rate, pauses and jumps."""

from collections.abc import Callable


class PlayClock:
    """Map recorded stamps to a steady clock.

    Everything is derived from one anchor (a stamp and the moment it was due), so that waiting a
    little too long for one message does not delay those after it.
    """

    def __init__(self, rate: float, steady_s: Callable[[], float]) -> None:
        """Start stopped.

        Args:
            rate: recorded seconds per second.
            steady_s: a clock that never jumps, e.g. time.monotonic.
        """
        self._rate = rate
        self._steady_s = steady_s
        self._anchor_ns = 0
        self._anchor_s: float | None = None

    def start(self, stamp_ns: int) -> None:
        """Let `stamp_ns` be now; also to jump."""
        self._anchor_ns = stamp_ns
        self._anchor_s = self._steady_s()

    def pause(self) -> None:
        """Stop at the present moment."""
        self._anchor_ns = self.now_ns()
        self._anchor_s = None

    def resume(self) -> None:
        """Go on from where it stopped."""
        if self._anchor_s is None:
            self._anchor_s = self._steady_s()

    def step_to(self, stamp_ns: int) -> None:
        """While paused, move on to a later stamp."""
        if self.paused:
            self._anchor_ns = max(self._anchor_ns, stamp_ns)

    @property
    def paused(self) -> bool:
        """True before `start` and between `pause` and `resume`."""
        return self._anchor_s is None

    def now_ns(self) -> int:
        """Return the recorded time that is now."""
        if self._anchor_s is None:
            return self._anchor_ns
        return self._anchor_ns + round((self._steady_s() - self._anchor_s) * self._rate * 1e9)

    def wait_s(self, stamp_ns: int) -> float:
        """Return the seconds until a stamp is due, negative when it is late; inf while paused."""
        if self._anchor_s is None:
            return float('inf')
        due_s = self._anchor_s + (stamp_ns - self._anchor_ns) * 1e-9 / self._rate
        return due_s - self._steady_s()
