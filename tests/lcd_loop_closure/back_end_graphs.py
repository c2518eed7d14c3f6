"""Graphs that several tests of the back-end use."""

import numpy as np

from lcd_common import se3
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig, diagonal
from lcd_loop_closure.graph_snapshot import GraphLoop, GraphSnapshot, LoopKey, LoopState
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig
from lcd_loop_closure.town_graphs import TownGraph, loop_between, stamp_ns


def snapshot_of_drive(graph: TownGraph) -> GraphSnapshot:
    """Return a drive as a snapshot that starts from chained odometry."""
    noise = GraphNoise(GraphNoiseConfig())
    rows = range(len(graph))
    return GraphSnapshot(
        np.arange(len(graph)),
        np.array([stamp_ns(row) for row in rows]),
        graph.T_odom_base,
        graph.T_odom_base,
        graph.motions,
        np.array([noise.odometry(graph.motions[r], graph.motion_covariances[r]) for r in rows]),
        loops=tuple(
            GraphLoop(loop, noise.loop(loop.covariance), LoopState.HELD) for loop in graph.loops
        ),
    )


def out_and_back(length: int = 60, seed: int = 0, *, declared: bool = False) -> TownGraph:
    """Drive out, turn on the spot and drive back; row `length` is the first after the turn.

    declared: odometry says that it does not know the turn.
    """
    rng = np.random.default_rng(seed)
    out = [np.eye(4)]
    for k in range(1, length):
        out.append(out[-1] @ se3.exp([2.0, 0, 0, 0, 0, 0.02 * np.sin(k / 9)]))
    back = [
        T @ se3.exp([*rng.normal(0, [0.2, 0.3, 0]), 0, 0, np.pi + rng.normal(0, 0.02)])
        for T in reversed(out)
    ]
    T = np.array(out + back)
    sigmas = np.repeat([0.01, 1e-3], 3)
    noise = np.array([se3.exp(sigmas * rng.normal(size=6)) for _ in T])
    motions = np.tile(np.eye(4), (len(T), 1, 1))
    motions[1:] = se3.inverse(T[:-1]) @ T[1:] @ noise[1:]
    covariances = np.tile(diagonal(0.01, 1e-3), (len(T), 1, 1))
    if declared:
        covariances[length] = diagonal(20.0, 3.0)
    loops = []
    for query in range(length + 10, 2 * length):
        match = 2 * length - 1 - query
        drawn = se3.exp(np.repeat([0.05, 5e-3], 3) * rng.normal(size=6))
        loops.append(loop_between(match, query, se3.inverse(T[match]) @ T[query] @ drawn))
    return TownGraph(T, motions, covariances, tuple(loops))


def run_online(graph: TownGraph, every: int = 10) -> tuple[PoseGraph, list[float]]:
    """Feed a drive with verdicts in between; return the graph and its error after every update.

    The error is that of the farthest keyframe, metres.
    """
    pose_graph, solver = PoseGraph(), RobustSolver(RobustSolverConfig())
    loops: dict[int, list[LoopConstraint]] = {}
    for loop in graph.loops:
        loops.setdefault(loop.query_id, []).append(loop)
    errors = []
    for keyframe in graph.keyframes():
        pose_graph.add_keyframe(keyframe)
        for loop in loops.get(keyframe.id, []):
            pose_graph.add_loop(loop)
        pose_graph.update()
        if keyframe.id % every == every - 1 and pose_graph.needs_verdict:
            pose_graph.apply(solver.solve(pose_graph.snapshot()))
        off = pose_graph.poses()[:, :3, 3] - graph.T_world_base[: len(pose_graph), :3, 3]
        errors.append(float(np.linalg.norm(off, axis=1).max()))
    return pose_graph, errors


def rmse_m(T_map_base: se3.Array, T_world_base: se3.Array) -> float:
    """Return the root mean square of the position errors, without alignment."""
    off = T_map_base[:, :3, 3] - T_world_base[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def keys(loops: tuple[LoopConstraint, ...]) -> set[LoopKey]:
    """Return the ids of loops."""
    return {(loop.match_id, loop.query_id) for loop in loops}
