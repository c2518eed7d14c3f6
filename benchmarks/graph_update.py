"""How long one update of a large pose graph takes, and how much memory a keyframe costs."""

import resource
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig
from lcd_loop_closure.town_graphs import TownGraphConfig, town_graph

if TYPE_CHECKING:
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

_VERDICT_EVERY = 1000


def evaluate(
    work: Path, keyframes: int = 10_000, measured: int = 2000, seed: int = 0
) -> dict[str, Any]:
    """Drive through a town online and time the last updates.

    One update is what the node does with a keyframe and its loops until its Path is out: the graph
    takes them in, and path and keyframe positions are made and published, by the node itself.
    Verdicts of the robust solver are carried in on the way, outside the timing, for they come from
    another process.
    """
    from lcd_common.nodes.parameters import overrides
    from lcd_loop_closure.nodes.offline_slam import own_context
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

    del work
    with own_context() as context:
        parameters = overrides(threaded=False, publish_tf=False)
        node = PoseGraphNode(context=context, parameter_overrides=parameters)
        try:
            return _timed(node, keyframes, measured, seed)
        finally:
            node.destroy_node()


def _timed(node: 'PoseGraphNode', keyframes: int, measured: int, seed: int) -> dict[str, Any]:
    town = town_graph(TownGraphConfig(keyframes=keyframes, streets=9, loop_share=1 / 3), seed)
    loops: dict[int, list[LoopConstraint]] = {}
    for loop in town.loops:
        loops.setdefault(loop.query_id, []).append(loop)
    graph, solver = node.map.graph, RobustSolver(RobustSolverConfig())
    wall_ms, cpu_ms, path_ms, with_loop, verdict_s, apply_ms = [], [], [], [], [], []
    memory_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for keyframe in town.keyframes():
        new = loops.get(keyframe.id, [])
        wall, cpu = time.perf_counter(), time.thread_time()
        _take(node, keyframe, new)
        graph_done = time.perf_counter()
        node.publish_graph()
        path_ms.append((time.perf_counter() - graph_done) * 1e3)
        wall_ms.append((time.perf_counter() - wall) * 1e3)
        cpu_ms.append((time.thread_time() - cpu) * 1e3)
        with_loop.append(bool(new))
        if keyframe.id % _VERDICT_EVERY == _VERDICT_EVERY // 2 and graph.needs_verdict:
            verdict = solver.solve(graph.snapshot())
            verdict_s.append(verdict.seconds)
            apply_ms.append(graph.apply(verdict).seconds * 1e3)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory_before
    last = slice(-measured, None)
    looped = np.array(with_loop[last])
    off = graph.poses()[:, :3, 3] - town.T_world_base[:, :3, 3]
    return {
        'keyframes': keyframes,
        'loops': len(town.loops),
        'measured_updates': measured,
        'measured_with_loop': int(looped.sum()),
        'p50_ms': _percentile(wall_ms[last], 50),
        'p99_ms': _percentile(wall_ms[last], 99),
        'max_ms': max(wall_ms[last]),
        'cpu_p50_ms': _percentile(cpu_ms[last], 50),
        'cpu_p99_ms': _percentile(cpu_ms[last], 99),
        'with_loop_p99_ms': _percentile(np.array(wall_ms[last])[looped], 99),
        'path_p50_ms': _percentile(path_ms[last], 50),
        'path_p99_ms': _percentile(path_ms[last], 99),
        'path_share': sum(path_ms[last]) / sum(wall_ms[last]),
        'apply_max_ms': max(apply_ms, default=0.0),
        'verdict_last_s': verdict_s[-1] if verdict_s else None,
        'rmse_m': float(np.sqrt((off**2).sum(axis=1).mean())),
        'bytes_per_keyframe': memory * 1024 / keyframes,
    }


def _take(node: 'PoseGraphNode', keyframe: Keyframe, loops: list[LoopConstraint]) -> None:
    """Bring the node's graph up to date with a keyframe and its loops."""
    node.map.add_keyframe(keyframe)
    for loop in loops:
        node.map.add_loop(loop)
    node.map.graph.update()


def _percentile(values: Any, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else float('nan')
