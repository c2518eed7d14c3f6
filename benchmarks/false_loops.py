"""Add wrong loops to known graphs and see whether they bend them.

python -m benchmarks.false_loops              all graphs (about ten minutes on two cores)
python -m benchmarks.false_loops --seeds 1    a quick look
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from evo.core.geometry import umeyama_alignment

from benchmarks.recordings import folder
from lcd_common import se3
from lcd_common.command_line import run
from lcd_loop_closure.g2o import read_g2o, snapshot_of
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig
from lcd_loop_closure.graph_snapshot import GraphLoop, GraphSnapshot, LoopState
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig, Verdict
from lcd_loop_closure.town_graphs import (
    TownGraph,
    TownGraphConfig,
    aliased_false_loops,
    random_false_loops,
    stamp_ns,
    town_graph,
)
from lcd_loop_closure.weighted_graph import WeightedGraph

KINDS = (('random', 1), ('random', 5), ('random', 20), ('random', 100), ('aliased', 15))
TOWN_KEYFRAMES = 1000
ONLINE_KEYFRAMES = 600
_VERDICT_EVERY = 25


@dataclass(frozen=True)
class Case:
    """A graph with its truth [N x 4 x 4] and the covariance of a loop in it."""

    name: str
    snapshot: GraphSnapshot
    T_world_base: se3.Array
    loop_covariance: se3.Array


def evaluate(work: Path, seeds: int = 3, town_seeds: int = 5) -> dict[str, Any]:
    """Measure all graphs, in one solve and online.

    Ratios are errors over the error of the solve without wrong loops; shares are fractions of 1.
    """
    del work
    figures: dict[str, Any] = {}
    for case in (sphere(), parking_garage()):
        figures[case.name] = batch(case, range(seeds))
    towns = [batch(town(seed), [seed]) for seed in range(town_seeds)]
    figures['town'] = _worst(towns)
    figures['online'] = online(range(min(town_seeds, 3)))
    parts = [figures[name] for name in ('sphere2500', 'parking_garage', 'town')]
    return {
        'worst_ate_ratio': max(part['worst_ate_ratio'] for part in parts),
        'true_kept_share': min(part['true_kept_share'] for part in parts),
        'wrong_accepted': sum(part['wrong_accepted'] for part in parts)
        + figures['online']['wrong_accepted'],
        **figures,
    }


def sphere() -> Case:
    """Return sphere2500 from chained odometry; its truth is the chain of noise-free edges."""
    data = folder() / 'data' / 'pose_graphs'
    snapshot = snapshot_of(read_g2o(data / 'sphere2500.txt'))
    truth = snapshot_of(read_g2o(data / 'sphere2500_groundtruth.txt')).T_odom_base
    return Case('sphere2500', snapshot, truth, snapshot.loops[0].covariance)


def parking_garage() -> Case:
    """Return parking-garage from chained odometry; its truth is least squares over all edges."""
    graph = read_g2o(folder() / 'data' / 'pose_graphs' / 'parking-garage.g2o')
    snapshot = snapshot_of(graph)
    assert graph.T_world_body is not None
    clean = WeightedGraph(replace(snapshot, T_map_base=graph.T_world_body))
    clean.settle(np.ones(len(snapshot.loops)), iterations=50)
    return Case('parking_garage', snapshot, clean.poses, snapshot.loops[0].covariance)


def town(seed: int, keyframes: int = TOWN_KEYFRAMES) -> Case:
    """Return a made-up drive through a town, with the covariances that the pose graph gives it."""
    graph, noise = town_graph(TownGraphConfig(keyframes=keyframes), seed), _noise()
    rows = range(keyframes)
    snapshot = GraphSnapshot(
        np.arange(keyframes),
        np.array([stamp_ns(row) for row in rows]),
        graph.T_odom_base,
        graph.T_odom_base,
        graph.motions,
        np.array([noise.odometry(graph.motions[r], graph.motion_covariances[r]) for r in rows]),
        loops=tuple(
            GraphLoop(loop, noise.loop(loop.covariance), LoopState.HELD) for loop in graph.loops
        ),
    )
    return Case('town', snapshot, graph.T_world_base, noise.loop(graph.loops[0].covariance))


def batch(case: Case, seeds: Sequence[int]) -> dict[str, Any]:
    """Solve a graph once without and once with each kind and seed of wrong loops."""
    solver = RobustSolver(RobustSolverConfig())
    true = {loop.key for loop in case.snapshot.loops}
    clean = solver.solve(case.snapshot)
    clean_m = ate_m(clean.T_map_base, case.T_world_base)
    figures: dict[str, Any] = {
        'keyframes': len(case.snapshot),
        'true_loops': len(true),
        'odometry_ate_m': ate_m(case.snapshot.T_odom_base, case.T_world_base),
        'clean': {
            'ate_m': clean_m,
            'true_kept_share': len(clean.accepted) / len(true),
            'seconds': clean.seconds,
        },
    }
    for kind, count in KINDS:
        runs = [_with_wrong(case, solver, kind, count, seed) for seed in seeds]
        figures[f'{kind}_{count}'] = {
            'ate_ratio': max(ate_m(v.T_map_base, case.T_world_base) for v in runs) / clean_m,
            'true_kept_share': min(len(v.accepted & true) / len(true) for v in runs),
            'wrong_accepted': sum(len(v.accepted - true) for v in runs),
            'seconds': max(v.seconds for v in runs),
        }
    measured = [figures[f'{kind}_{count}'] for kind, count in KINDS]
    return {
        'worst_ate_ratio': max(m['ate_ratio'] for m in measured),
        'true_kept_share': min(m['true_kept_share'] for m in measured),
        'wrong_accepted': sum(m['wrong_accepted'] for m in measured),
        **figures,
    }


def online(seeds: Sequence[int]) -> dict[str, Any]:
    """Drive through towns with wrong loops arriving one by one.

    error_ratio: the farthest keyframe's error at the worst moment, over the same without any.
    """
    figures: dict[str, Any] = {}
    for kind, count in (('random', 100), ('aliased', 15)):
        ratios, kept, wrong = [], [], 0
        for seed in seeds:
            graph = town_graph(TownGraphConfig(keyframes=ONLINE_KEYFRAMES), seed)
            true = {(loop.match_id, loop.query_id) for loop in graph.loops}
            worst_clean_m = max(drive(graph, PoseGraph()))
            pose_graph = PoseGraph()
            with_wrong = graph.with_loops(wrong_loops(graph, kind, count, seed))
            ratios.append(max(drive(with_wrong, pose_graph)) / worst_clean_m)
            final = {(c.match_id, c.query_id) for c in pose_graph.loops() if c.accepted}
            wrong += len(final - true)
            kept.append(len(final & true) / len(true))
        figures[f'{kind}_{count}'] = {
            'error_ratio_at_worst_moment': max(ratios),
            'true_kept_share': min(kept),
            'wrong_accepted': wrong,
        }
    figures['wrong_accepted'] = sum(part['wrong_accepted'] for part in figures.values())
    return figures


def drive(graph: TownGraph, pose_graph: PoseGraph) -> Iterator[float]:
    """Feed a drive and its loops as they come; yield the farthest keyframe's error, metres."""
    solver = RobustSolver(RobustSolverConfig())
    loops: dict[int, list[LoopConstraint]] = {}
    for loop in graph.loops:
        loops.setdefault(loop.query_id, []).append(loop)
    for keyframe in graph.keyframes():
        pose_graph.add_keyframe(keyframe)
        for loop in loops.get(keyframe.id, []):
            pose_graph.add_loop(loop)
        pose_graph.update()
        yield _farthest_m(pose_graph, graph)
        if keyframe.id % _VERDICT_EVERY == 0 and pose_graph.needs_verdict:
            pose_graph.apply(solver.solve(pose_graph.snapshot()))
            yield _farthest_m(pose_graph, graph)


def wrong_loops(graph: TownGraph, kind: str, count: int, seed: int) -> tuple[LoopConstraint, ...]:
    """Return wrong loops of a kind; the seed is not the one of the drive's own noise."""
    make = random_false_loops if kind == 'random' else aliased_false_loops
    return make(graph, count, seed + 1000)


def ate_m(T_map_base: se3.Array, T_world_base: se3.Array) -> float:
    """Return the root mean square of the position errors after alignment (Umeyama, no scale)."""
    estimate, truth = T_map_base[:, :3, 3], T_world_base[:, :3, 3]
    R, t, _ = umeyama_alignment(estimate.T, truth.T)
    return float(np.sqrt(((estimate @ R.T + t - truth) ** 2).sum(axis=1).mean()))


def _with_wrong(case: Case, solver: RobustSolver, kind: str, count: int, seed: int) -> Verdict:
    nothing = np.zeros((0, 4, 4))
    graph = TownGraph(case.T_world_base, nothing, nothing, ())
    true = {loop.key for loop in case.snapshot.loops}
    wrong = tuple(
        GraphLoop(loop, case.loop_covariance, LoopState.HELD)
        for loop in wrong_loops(graph, kind, count, seed)
        if (loop.match_id, loop.query_id) not in true
    )
    return solver.solve(replace(case.snapshot, loops=case.snapshot.loops + wrong))


def _farthest_m(pose_graph: PoseGraph, graph: TownGraph) -> float:
    off = pose_graph.poses()[:, :3, 3] - graph.T_world_base[: len(pose_graph), :3, 3]
    return float(np.linalg.norm(off, axis=1).max())


def _noise() -> GraphNoise:
    return GraphNoise(GraphNoiseConfig())


def _worst(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Merge the figures of several graphs: the worst of each."""
    out: dict[str, Any] = {}
    for key, value in runs[0].items():
        values = [run[key] for run in runs]
        if isinstance(value, dict):
            out[key] = _worst(values)
        elif key.endswith('share'):
            out[key] = min(values)
        elif key == 'wrong_accepted':
            out[key] = sum(values)
        else:
            out[key] = max(values)
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--seeds', type=int, default=3, help='seeds for the public graphs')
    parser.add_argument('--town-seeds', type=int, default=5, help='seeds for the towns')
    arguments = parser.parse_args(argv)
    started = time.perf_counter()
    figures = evaluate(Path(), arguments.seeds, arguments.town_seeds)
    figures['total_seconds'] = time.perf_counter() - started
    sys.stdout.write(json.dumps(figures, indent=2) + '\n')
    return 0


if __name__ == '__main__':
    sys.exit(run(main))
