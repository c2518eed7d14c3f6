"""Keep what happened lately, so that what comes late takes its place as if it had come in time."""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from cmrnet_ekf.ekf.motion_state import MotionState

Result = TypeVar('Result')
Key = tuple[int, int, str, int]


@dataclass(frozen=True, slots=True)
class Entry(Generic[Result]):
    """Something that happened: its place among all others, and what it does to a state."""

    key: Key
    apply: Callable[[MotionState], tuple[MotionState, Result]]

    @property
    def stamp_ns(self) -> int:
        """Time at which it happened."""
        return self.key[0]


class History(Generic[Result]):
    """A sequence of entries in the order of their keys, with the state after each.

    The states are a function of the set of entries alone: the order in which they come does not
    matter, to the last bit, as long as none is too late.
    """

    def __init__(self, start: MotionState, length_ns: int) -> None:
        self._length_ns = length_ns
        self._base = start
        self._keys: list[Key] = []
        self._entries: list[Entry[Result]] = []
        self._states: list[MotionState] = []
        self.replayed = 0

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def newest(self) -> MotionState:
        """State after the last entry."""
        return self._states[-1] if self._states else self._base

    @property
    def begin_ns(self) -> int:
        """Stamp before which nothing can be put in any more."""
        return self._base.stamp_ns

    def knows(self, key: Key) -> bool:
        """Tell whether there is an entry of this key already."""
        at = bisect_left(self._keys, key)
        return at < len(self._keys) and self._keys[at] == key

    def put(self, *entries: Entry[Result]) -> list[Result]:
        """Put entries in their places and redo what follows; return what became of each.

        The keys must be new, and not before `begin_ns`.
        """
        if len(entries) == 1 and (not self._keys or entries[0].key > self._keys[-1]):
            state, result = entries[0].apply(self.newest)
            self._append(entries[0], state)
            self._forget()
            return [result]
        first = len(self._keys)
        for entry in entries:
            at = bisect_left(self._keys, entry.key)
            self._keys.insert(at, entry.key)
            self._entries.insert(at, entry)
            first = min(first, at)
        again = self._entries[first:]
        del self._keys[first:], self._entries[first:], self._states[first:]
        results = {}
        for entry in again:
            state, results[entry.key] = entry.apply(self.newest)
            self._append(entry, state)
        self.replayed += len(again) - len(entries)
        self._forget()
        return [results[entry.key] for entry in entries]

    def at(self, stamp_ns: int) -> MotionState | None:
        """Return the last state that is not later than a stamp; None before the history."""
        at = bisect_left(self._keys, (stamp_ns + 1,))
        if at:
            return self._states[at - 1]
        return self._base if self._base.stamp_ns <= stamp_ns else None

    def _append(self, entry: Entry[Result], state: MotionState) -> None:
        self._keys.append(entry.key)
        self._entries.append(entry)
        self._states.append(state)

    def _forget(self) -> None:
        """Drop what is older than the length, a quarter of it at a time (that is cheap)."""
        limit_ns = self._keys[-1][0] - self._length_ns
        if self._keys[0][0] >= limit_ns - self._length_ns // 4:
            return
        count = bisect_left(self._keys, (limit_ns,))
        self._base = self._states[count - 1]
        del self._keys[:count], self._entries[:count], self._states[:count]
