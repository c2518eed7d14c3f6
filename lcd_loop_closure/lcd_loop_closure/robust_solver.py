"""Find the false loops of a whole graph. (skeleton)"""

from dataclasses import dataclass

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.graph_snapshot import GraphSnapshot, LoopKey


@config
class RobustSolverConfig:
    """How the solver tells false loops from true ones."""

    inlier_probability: float = setting(
        0.999, 'share of true loops that pass the residual test', low=0.5, high=0.999999
    )


@dataclass(frozen=True)
class Verdict:
    """What the solver found out about the loops of a snapshot.

    Attributes:
        accepted: loops that belong to the graph.
        rejected: loops that do not, each with one sentence for people.
        broken_links: ids of keyframes whose link to their predecessor is wrong.
        ids, T_map_base: the solved poses [N x 4 x 4] of the snapshot's keyframes.
        iterations: linear solves.
        seconds: wall time.
    """

    accepted: frozenset[LoopKey]
    rejected: dict[LoopKey, str]
    broken_links: tuple[int, ...]
    ids: se3.Array
    T_map_base: se3.Array
    iterations: int
    seconds: float


class RobustSolver:
    """Judge all loops of a snapshot together; runs beside the filter, shares nothing with it."""

    def __init__(self, settings: RobustSolverConfig) -> None:
        self.settings = settings

    def solve(self, snapshot: GraphSnapshot) -> Verdict:
        """Return which loops are right."""
        raise NotImplementedError
