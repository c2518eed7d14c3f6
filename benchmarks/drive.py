"""Measure the figures of the SLAM part and write benchmarks/results/drive.json.

    python -m benchmarks.drive                      everything (about an hour on two cores)
    python -m benchmarks.drive --only u_turn peers  some sections; the others keep their figures
    python -m benchmarks.drive --quick              shorter: a quarter of an hour of replay,
                                                    every tenth sweep across data sets, one U-turn
    python -m benchmarks.drive --list               the sections and what they measure

Exits with 1 when a section failed or a required figure is missing.
"""

import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

REQUIRED = (
    'out_and_back.odometry_lost',
    'out_and_back.odometry_latency_p50_ms',
    'out_and_back.odometry_latency_p99_ms',
    'out_and_back.loops_found_share',
    'out_and_back.loops_wrong',
    'out_and_back.end_error_m',
    'out_and_back.lockstep_realtime_factor',
    'kitti_00.pair_translation_error_m',
    'kitti_00.pair_rotation_error_deg',
    'kitti_00.negatives',
    'kitti_00.negatives_rejected',
    'kitti_08.loops',
    'kitti_08.pairs',
    'false_loops.worst_ate_ratio',
    'false_loops.true_kept_share',
    'false_loops.wrong_accepted',
    'u_turn.ate_m',
    'u_turn.kiss_slam_ate_m',
    'u_turn.broken.ate_m',
    'graph_update_p99_ms_at_10000',
    'memory.bytes_per_keyframe',
    'memory.without_keyframes_growth_mb_per_hour',
    'peers.kiss_slam.*',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import drives, false_loops, graph_update, loop_pairs, memory, odometry

    return {
        'kitti_08': ('revisits of the thesis counted on KITTI 08', loop_pairs.count_kitti_08),
        'kitti_00': (
            'one true and many false pairs of real scans',
            partial(loop_pairs.evaluate, sweep_step=10) if quick else loop_pairs.evaluate,
        ),
        'odometry': ('consistency of the odometry covariance in simulation', odometry.evaluate),
        'false_loops': (
            'wrong loops added to known graphs',
            partial(false_loops.evaluate, seeds=1, town_seeds=3) if quick else false_loops.evaluate,
        ),
        'graph_update': ('one update among 10,000 keyframes', graph_update.evaluate),
        'out_and_back': ('real sweeps at 1x through DDS', drives.out_and_back_live),
        'lockstep': ('the same sweeps in lock-step', drives.out_and_back_lockstep),
        'u_turn': (
            'a turn that breaks odometry, beside KISS-SLAM',
            partial(drives.u_turn, towns=1) if quick else drives.u_turn,
        ),
        'peers': ('the same folders through KISS-SLAM', drives.side_by_side),
        'memory': (
            'an hour of replay, and a quarter without keyframes',
            partial(memory.evaluate, recorded_s=900.0) if quick else memory.evaluate,
        ),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    benchmark = Benchmark('drive', __doc__ or '', sections, REQUIRED, _placed)
    return run_benchmark(benchmark, argv)


def _placed(figures: dict[str, Any], section: str, new: dict[str, Any]) -> dict[str, Any]:
    """Put a section's figures where the result tables expect them."""
    figures = dict(figures)
    if section == 'lockstep':
        figures['out_and_back'] = {**figures.get('out_and_back', {}), **new}
    elif section == 'out_and_back':
        kept = {k: v for k, v in figures.get(section, {}).items() if k.startswith('lockstep')}
        figures[section] = {**new, **kept}
    elif section == 'graph_update':
        figures['graph_update'] = new
        figures['graph_update_p99_ms_at_10000'] = new['p99_ms']
    else:
        figures[section] = new
    return figures


if __name__ == '__main__':
    sys.exit(main())
