"""Remember every loop that was offered and what became of it."""

from collections.abc import Iterator
from dataclasses import replace

from lcd_common import se3
from lcd_loop_closure.graph_snapshot import GraphLoop, LoopKey, LoopState
from lcd_loop_closure.loop import LoopConstraint, LoopStatus

_STATUS = {
    LoopState.HELD: LoopStatus.REJECTED_INCONSISTENT,
    LoopState.TENTATIVE: LoopStatus.ACCEPTED,
    LoopState.CONFIRMED: LoopStatus.ACCEPTED,
    LoopState.REJECTED: LoopStatus.REJECTED_BY_GRAPH,
    LoopState.BY_HAND: LoopStatus.ACCEPTED,
    LoopState.UNUSED: LoopStatus.REJECTED_BY_HAND,
}


class LoopLedger:
    """Loops by their keyframes' ids; a loop between the same two replaces the earlier one."""

    def __init__(self) -> None:
        self._loops: dict[LoopKey, GraphLoop] = {}
        self._of_query: dict[int, list[LoopKey]] = {}
        self.arrivals = 0

    def restore(self, loops: tuple[GraphLoop, ...], arrivals: int) -> None:
        """Hold these loops instead."""
        self._loops, self._of_query = {}, {}
        for loop in loops:
            self._put(loop)
        self.arrivals = arrivals

    def __contains__(self, key: LoopKey) -> bool:
        return key in self._loops

    def __getitem__(self, key: LoopKey) -> GraphLoop:
        return self._loops[key]

    def __iter__(self) -> Iterator[GraphLoop]:
        return iter(tuple(self._loops.values()))

    def __len__(self) -> int:
        return len(self._loops)

    def add(self, constraint: LoopConstraint, covariance: se3.Array, state: LoopState) -> None:
        """Remember a loop that arrives, last in order."""
        loop = GraphLoop(constraint, covariance, state, self.arrivals)
        self._put(loop)
        self.arrivals += 1

    def of_query(self, keyframe_id: int) -> list[GraphLoop]:
        """Return the loops that this keyframe closed."""
        return [self._loops[key] for key in self._of_query.get(keyframe_id, [])]

    def _put(self, loop: GraphLoop) -> None:
        if self._loops.pop(loop.key, None) is None:
            self._of_query.setdefault(loop.key[1], []).append(loop.key)
        self._loops[loop.key] = loop

    def decide(self, key: LoopKey, state: LoopState, reason: str = '') -> None:
        """Change what the graph does with a loop, and say so in its constraint."""
        loop = self._loops[key]
        constraint = replace(loop.constraint, status=_STATUS[state], reason=reason)
        self._loops[key] = replace(loop, constraint=constraint, state=state)
