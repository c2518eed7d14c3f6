"""Have the loops of a live graph judged beside it."""

from collections.abc import Callable

from rclpy.node import Node

from lcd_common.nodes.worker import Worker
from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig, Verdict
from lcd_loop_closure.verdict_process import VerdictProcess


class GraphJudge:
    """Solve snapshots one at a time and hand each verdict back on the node's own executor.

    Threaded, the solve runs in a process of its own, and a verdict that is ready wakes the
    executor. Otherwise `consider` returns when the verdict is handed back.
    """

    def __init__(
        self,
        node: Node,
        settings: RobustSolverConfig,
        *,
        threaded: bool,
        niceness: int,
        on_verdict: Callable[[PoseGraph, Verdict], None],
        on_error: Callable[[Exception], None],
    ) -> None:
        """Make a judge.

        Args:
            node: whose executor calls `on_verdict`.
            settings: of the solver.
            threaded: False solves inside `consider`.
            niceness: of the solver's process.
            on_verdict: called with the graph that was judged, and the verdict.
            on_error: called on the worker's thread when a solve fails.
        """
        self._threaded, self._on_verdict, self._stopping = threaded, on_verdict, False
        self._process = VerdictProcess(settings, niceness) if threaded else None
        if self._process is not None:
            self._process.start()
        solver = self._process or RobustSolver(settings)
        self._solve = solver.solve
        self._ready: list[tuple[PoseGraph, Verdict]] = []
        self._asked: tuple[PoseGraph, int] | None = None
        self._wake = node.create_guard_condition(self.hand_over)
        self._worker: Worker[tuple[PoseGraph, GraphSnapshot]] = Worker(
            self._work,
            capacity=1,
            threaded=threaded,
            on_drop=lambda item: None,
            on_error=lambda error: None if self._stopping else on_error(error),
            name=f'{node.get_name()} judge',
        )

    def consider(self, graph: PoseGraph) -> bool:
        """Have a graph judged when loops came that nobody has judged; one at a time.

        Returns:
            Whether a solve was asked for.
        """
        if not graph.needs_verdict or not self._worker.idle() or self._ready:
            return False
        snapshot = graph.snapshot()
        if self._asked == (graph, snapshot.arrivals):
            return False
        self._asked = graph, snapshot.arrivals
        self._worker.put((graph, snapshot))
        return True

    def hand_over(self) -> None:
        """Hand over the verdicts that are ready, on the caller's thread."""
        while self._ready:
            self._on_verdict(*self._ready.pop(0))

    def under_way(self) -> int:
        """Return how many graphs are being judged, or have a verdict that is not handed over."""
        return len(self._ready) + (not self._worker.idle())

    def stop(self) -> None:
        """End the worker and the solver's process."""
        self._stopping = True
        if self._process is not None:
            self._process.close()
        self._worker.stop()

    def _work(self, item: tuple[PoseGraph, GraphSnapshot]) -> None:
        graph, snapshot = item
        self._ready.append((graph, self._solve(snapshot)))
        if self._threaded:
            self._wake.trigger()
        else:
            self.hand_over()
