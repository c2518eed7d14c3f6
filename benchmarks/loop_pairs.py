"""Ask the loop detector about single pairs of real scans: one true loop, many different places.

python -m benchmarks.loop_pairs                   all pairs (about 20 minutes on two cores)
python -m benchmarks.loop_pairs --sweep-step 10   every tenth of the Karlsruhe sweeps
"""

import argparse
import itertools
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bags.drives import open_drive
from bags.records import LidarScan
from benchmarks.recordings import folder, karlsruhe_out_and_back
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.command_line import run
from lcd_common.trajectory import read_poses
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pair_registration import PairRegistration, PairResult, PreparedCloud
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.revisits import count_revisits

TRUE_PAIR = (52, 4501)
FALSE_PAIR = (88, 850)
YAWS = 20
DIFFERENT_PLACE_M = 20.0
# Every cloud is put where KITTI's LiDAR sits, whatever it was mounted on: the ground then lies at
# another height in another data set, as the detector must expect.
T_BASE_LIDAR = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 1.73])
_BLOCK = 60


def count_kitti_08(work: Path) -> dict[str, Any]:
    """Count the revisits of KITTI 08 by the thesis's rules."""
    del work
    counted = count_revisits(
        read_poses(folder() / 'data' / 'kitti_odometry' / 'poses_lidar_08.txt')
    )
    return {
        'scans': counted.scans,
        'loops': counted.loops,
        'pairs': counted.pairs,
        'reverse_share': counted.reverse_share,
    }


def evaluate(work: Path, sweep_step: int = 1) -> dict[str, Any]:
    """Measure the true pair from random yaws and every pair of different places.

    Args:
        work: folder for the unpacked Karlsruhe sweeps.
        sweep_step: takes every n-th Karlsruhe sweep across data sets; 1 takes all 360.
    """
    pairs = PairRegistration()
    return {**true_pair(pairs), **negatives(pairs, work, sweep_step)}


def true_pair(pairs: PairRegistration, yaws: int = YAWS) -> dict[str, Any]:
    """Register KITTI 00's scans 52 and 4501 with one of them turned; the worst errors of all."""
    scans, T_world_base = kitti_00()
    match, query = (scans[i] for i in TRUE_PAIR)
    T_match_query = se3.inverse(T_world_base[TRUE_PAIR[0]]) @ T_world_base[TRUE_PAIR[1]]
    prepared = prepare(pairs, match)
    accepted, errors, fitness, overlap, seconds = 0, [], [], [], []
    for yaw in np.random.default_rng(0).uniform(-np.pi, np.pi, yaws):
        T_query_turned = se3.rotation_z(yaw)
        start = time.thread_time()
        result = pairs.compare(prepared, prepare(pairs, query, T_query_turned))
        seconds.append(time.thread_time() - start)
        if result.status is not LoopStatus.ACCEPTED:
            continue
        assert result.T_match_query is not None and result.verdict is not None
        accepted += 1
        errors.append(se3.distance(T_match_query @ T_query_turned, result.T_match_query))
        fitness.append(result.verdict.fitness)
        overlap.append(result.verdict.overlap)
    metres, radians = np.max(errors, axis=0) if errors else (None, None)
    return {
        'pair_yaws': yaws,
        'pair_accepted': accepted,
        'pair_translation_error_m': metres,
        'pair_rotation_error_deg': None if radians is None else float(np.degrees(radians)),
        'pair_smallest_fitness': min(fitness, default=None),
        'pair_smallest_overlap': min(overlap, default=None),
        'pair_cpu_ms': 1e3 * float(np.median(seconds)),
    }


def negatives(pairs: PairRegistration, work: Path, sweep_step: int = 1) -> dict[str, Any]:
    """Compare scans of different places within KITTI 00 and across four data sets."""
    limits = pairs.verification.settings
    outcomes: Counter[str] = Counter()
    by_set: dict[str, list[int]] = {}
    fitness, overlap = [0.0], [0.0]
    accepted_pairs = []
    start, compared = time.thread_time(), 0
    for name, match_id, query_id, result in _negative_pairs(pairs, work, sweep_step):
        compared += 1
        rejected = result.status is not LoopStatus.ACCEPTED
        counts = by_set.setdefault(name, [0, 0])
        counts[0] += 1
        counts[1] += rejected
        outcomes[result.status.name.lower()] += 1
        if result.verdict is not None:
            fitness.append(result.verdict.fitness)
            overlap.append(result.verdict.overlap)
        if not rejected:
            accepted_pairs.append(f'{name} {match_id} {query_id}')
    return {
        'negatives': sum(total for total, _ in by_set.values()),
        'negatives_rejected': sum(rejected for _, rejected in by_set.values()),
        'negatives_by_set': {name: total for name, (total, _) in by_set.items()},
        'negatives_accepted_pairs': ', '.join(accepted_pairs) or 'none',
        'negatives_largest_fitness': max(fitness),
        'negatives_largest_overlap': max(overlap),
        'negatives_cpu_ms': 1e3 * (time.thread_time() - start) / max(compared, 1),
        'negatives_by_verdict': dict(outcomes),
        'limits': {'fitness': limits.min_fitness, 'overlap': limits.min_overlap},
    }


def kitti_00() -> tuple[dict[int, PointCloud], se3.Array]:
    """Return the scans of KITTI 00 that are there, by number, and T_world_base of all 4541."""
    drive = open_drive(folder() / 'data' / 'kitti_odometry', sequence='00')
    truth = drive.truth()
    assert truth is not None
    scans = {}
    for record in drive.records(kinds=[LidarScan]):
        assert isinstance(record, LidarScan)
        scans[int(np.argmin(np.abs(truth.stamps_ns - record.stamp_ns)))] = record.cloud
    return scans, truth.T_world_body


def prepare(
    pairs: PairRegistration, cloud: PointCloud, T_base_turned: se3.Array | None = None
) -> PreparedCloud:
    """Reduce a sweep (LiDAR frame) as a keyframe's, seen from a base that is turned."""
    T_turned_base = np.eye(4) if T_base_turned is None else se3.inverse(T_base_turned)
    in_base = cloud.transformed(T_turned_base @ T_BASE_LIDAR)
    return pairs.prepare(reduce_cloud(in_base, ReductionConfig()).xyz)


def _negative_pairs(
    pairs: PairRegistration, work: Path, sweep_step: int
) -> Iterator[tuple[str, int, int, PairResult]]:
    scans, T_world_base = kitti_00()
    within = {i: prepare(pairs, cloud) for i, cloud in scans.items()}
    for i, j in itertools.combinations(sorted(within), 2):
        away = np.linalg.norm(T_world_base[i][:3, 3] - T_world_base[j][:3, 3])
        if away > DIFFERENT_PLACE_M:
            yield 'kitti_00', i, j, pairs.compare(within[i], within[j])
    data = folder() / 'data'
    sets = {
        'kitti_00': list(within.values()),
        'kitti_360': [prepare(pairs, cloud) for cloud in clouds(data / 'kitti_360')],
        'argoverse2': [prepare(pairs, cloud) for cloud in clouds(data / 'argoverse2' / '7fab2350')],
    }
    for (a, matches), (b, queries) in itertools.combinations(sets.items(), 2):
        for (i, match), (j, query) in itertools.product(enumerate(matches), enumerate(queries)):
            yield f'{a}+{b}', i, j, pairs.compare(match, query)
    sweeps = itertools.islice(clouds(karlsruhe_out_and_back(work).parents[1]), 0, None, sweep_step)
    # In blocks: the prepared sweeps of the whole drive would fill a gigabyte.
    for block in itertools.count():
        part = list(itertools.islice(sweeps, _BLOCK))
        if not part:
            return
        prepared = [prepare(pairs, cloud) for cloud in part]
        for name, others in sets.items():
            for (i, match), (j, query) in itertools.product(enumerate(prepared), enumerate(others)):
                number = (block * _BLOCK + i) * sweep_step
                yield f'karlsruhe+{name}', number, j, pairs.compare(match, query)


def clouds(path: Path) -> Iterator[PointCloud]:
    """Yield the sweeps of a recording, LiDAR frame."""
    for record in open_drive(path).records(kinds=[LidarScan]):
        assert isinstance(record, LidarScan)
        yield record.cloud


def main(argv: Sequence[str] | None = None) -> int:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.loop_pairs',
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--work', type=Path, default=Path('build/benchmarks'))
    parser.add_argument('--sweep-step', type=int, default=1, help='every n-th Karlsruhe sweep')
    arguments = parser.parse_args(argv)

    def work() -> None:
        arguments.work.mkdir(parents=True, exist_ok=True)
        figures = {
            'kitti_08': count_kitti_08(arguments.work),
            'kitti_00': evaluate(arguments.work, arguments.sweep_step),
        }
        sys.stdout.write(json.dumps(figures, indent=2) + '\n')

    return run(work)


if __name__ == '__main__':
    raise SystemExit(main())
