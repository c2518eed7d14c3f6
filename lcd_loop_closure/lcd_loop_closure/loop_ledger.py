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
        self.arrivals = 0

    def restore(self, loops: tuple[GraphLoop, ...], arrivals: int) -> None:
        """Hold these loops instead."""
        self._loops = {loop.key: loop for loop in loops}
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
        self._loops.pop(loop.key, None)
        self._loops[loop.key] = loop
        self.arrivals += 1

    def decide(self, key: LoopKey, state: LoopState, reason: str = '') -> None:
        """Change what the graph does with a loop, and say so in its constraint."""
        loop = self._loops[key]
        constraint = replace(loop.constraint, status=_STATUS[state], reason=reason)
        self._loops[key] = replace(loop, constraint=constraint, state=state)
