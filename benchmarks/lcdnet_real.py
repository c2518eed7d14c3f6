"""LCDNet on real sweeps, none of which it was trained or chosen on."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bags.drives import open_drive
from benchmarks.lcdnet_drives import METHODS, methods
from benchmarks.lcdnet_peers import map_closure_candidates
from benchmarks.loop_pairs import (
    DIFFERENT_PLACE_M,
    T_BASE_LIDAR,
    TRUE_PAIR,
    YAWS,
    clouds,
    kitti_00,
)
from benchmarks.peers import PeerError
from benchmarks.recordings import folder, karlsruhe_out_and_back
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.evaluation.detection_protocols import protocol_1
from lcd_loop_closure.evaluation.drive_sweeps import store_drive
from lcd_loop_closure.evaluation.lcdnet_registration import (
    LcdnetFast,
    LcdnetRansac,
    NodeRegistration,
)
from lcd_loop_closure.evaluation.registration_errors import errors_of
from lcd_loop_closure.evaluation.study import JudgedMethod, study_detection, terminal_bar
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, is_stored
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pair_registration import PreparedCloud
from lcd_loop_closure.revisits import RevisitConfig


def places(work: Path) -> dict[str, Any]:
    """Tell places: the out-and-back drive, and frames beside their neighbours."""
    return {
        'real': {
            'out_and_back': out_and_back(work),
            'neighbours': neighbours(methods().lcdnet),
        }
    }


def pairs(work: Path, sweep_step: int = 1) -> dict[str, Any]:
    """Register a true pair and different places, every `sweep_step`-th Karlsruhe sweep's."""
    network = methods().lcdnet
    found = {**true_pair(network), **negatives(network, work, sweep_step)}
    return {'real': {'kitti_00': found}}


def true_pair(network: LcdnetDescriptor, yaws: int = YAWS) -> dict[str, Any]:
    """Register KITTI 00's scans 52 and 4501 with one of them turned; the worst errors of all."""
    scans, T_world_base = kitti_00()
    match, query = (in_base(scans[i]) for i in TRUE_PAIR)
    T_match_query = se3.inverse(T_world_base[TRUE_PAIR[0]]) @ T_world_base[TRUE_PAIR[1]]
    figures: dict[str, Any] = {'pair_yaws': yaws}
    turns = [se3.rotation_z(y) for y in np.random.default_rng(0).uniform(-np.pi, np.pi, yaws)]
    for registration in (NodeRegistration(network), LcdnetRansac(network), LcdnetFast(network)):
        prepared: Any = registration.prepare(match)
        answers = []
        for T_query_turned in turns:
            turned: Any = registration.prepare(query.transformed(se3.inverse(T_query_turned)))
            answers.append(registration.register(prepared, turned))
        errors = errors_of(answers, np.array([T_match_query @ T for T in turns]))
        end = '' if registration.name == 'lcdnet' else f'_{registration.name}'
        answered = np.isfinite(errors.te_m)
        figures |= {
            f'pair_registered{end}': int(errors.success_full.sum()),
            f'pair_translation_error_m{end}': _worst(errors.te_m, answered),
            f'pair_rotation_error_deg{end}': _worst(errors.re_deg, answered),
        }
    return figures


def negatives(network: LcdnetDescriptor, work: Path, sweep_step: int = 1) -> dict[str, Any]:
    """Register and verify scans of different places within KITTI 00 and across data sets."""
    registration = NodeRegistration(network)
    compared = rejected = 0
    fitness, wrong = [0.0], []
    for name, match, query in tqdm(_different(registration, work, sweep_step), desc='negatives'):
        result = registration.judge(match, query)
        compared += 1
        if result.verdict is not None:
            fitness.append(result.verdict.fitness)
        if result.status is not LoopStatus.ACCEPTED:
            rejected += 1
        else:
            wrong.append(name)
    return {
        'negatives': compared,
        'negatives_rejected': rejected,
        'negatives_accepted_pairs': ', '.join(wrong) or 'none',
        'negatives_largest_fitness': max(fitness),
    }


def out_and_back(work: Path) -> dict[str, Any]:
    """Return average precision on the Karlsruhe drive (real sweeps, semi-synthetic order)."""
    sequence = karlsruhe_out_and_back(work)
    kept = work / 'sweeps' / 'karlsruhe_out_and_back'
    if not is_stored(kept):
        drive = open_drive(sequence)
        drive.name = kept.name
        with terminal_bar('reading Karlsruhe', sum(s.count for s in drive.streams())) as step:
            store_drive(drive, kept, progress=lambda done, of: step())
    sweeps = StoredSweeps(kept)
    judged = study_detection(
        methods(), METHODS, {'whole': sweeps}, RevisitConfig(),
        folder=work / 'descriptors', bar=terminal_bar,
    )['whole']  # fmt: skip
    figures: dict[str, Any] = {'scans': len(sweeps)}
    for name, one in judged.items():
        if not isinstance(one, JudgedMethod):
            figures.setdefault('missing', {})[name] = one
            continue
        for protocol, curves in (
            ('ap_protocol1', one.detection.protocol_1),
            ('ap_protocol2', one.detection.protocol_2),
        ):
            figures.setdefault(protocol, {})[name] = curves['all'].average_precision
        figures.setdefault('recall_1', {})[name] = one.detection.found.recall_1
    try:
        found = map_closure_candidates(work, sweeps)
    except PeerError as error:
        figures.setdefault('missing', {})['map_closures'] = str(error)
        return figures
    figures['ap_protocol1']['map_closures'] = protocol_1(found).average_precision
    figures['recall_1']['map_closures'] = found.recall_1
    return figures


def neighbours(network: LcdnetDescriptor) -> dict[str, Any]:
    """Return how many consecutive frames have a neighbour in time nearest of all frames.

    All frames of both data sets are compared with one another.
    """
    scans, _ = kitti_00()
    frames: list[tuple[str, int, PointCloud]] = [
        ('kitti_00', i, in_base(cloud)) for i, cloud in sorted(scans.items())
    ]
    frames += [
        ('kitti_360', i, in_base(cloud))
        for i, cloud in enumerate(clouds(folder() / 'data' / 'kitti_360'))
    ]
    rows = np.array([network.describe(cloud) for _, _, cloud in frames])
    distance = np.linalg.norm(rows[:, None] - rows[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    figures: dict[str, Any] = {}
    for name, last in (('kitti_00', 15), ('kitti_360', 10**9)):
        asked = [k for k, (of, i, _) in enumerate(frames) if of == name and i <= last]
        nearest = [frames[int(np.argmin(distance[k]))] for k in asked]
        right = [
            of == name and abs(i - frames[k][1]) == 1
            for k, (of, i, _) in zip(asked, nearest, strict=True)
        ]
        same = [of == name and i <= last for of, i, _ in nearest]
        figures[name] = {
            'frames': len(asked),
            'nearest_is_next_or_before': int(np.sum(right)),
            'nearest_is_of_the_same_stretch': int(np.sum(same)),
        }
    return figures


def in_base(cloud: PointCloud) -> PointCloud:
    """Return a cloud as if its LiDAR were mounted as KITTI's."""
    return cloud.transformed(T_BASE_LIDAR)


def _different(
    registration: NodeRegistration, work: Path, sweep_step: int
) -> Iterator[tuple[str, PreparedCloud, PreparedCloud]]:
    scans, T_world_base = kitti_00()
    ready = {i: registration.prepare(in_base(cloud)) for i, cloud in sorted(scans.items())}
    for i, j in itertools.combinations(sorted(ready), 2):
        if np.linalg.norm(T_world_base[i][:3, 3] - T_world_base[j][:3, 3]) > DIFFERENT_PLACE_M:
            yield f'kitti_00 {i} {j}', ready[i], ready[j]
    data = folder() / 'data'
    sets = {
        'kitti_00': list(ready.values()),
        'kitti_360': [registration.prepare(in_base(c)) for c in clouds(data / 'kitti_360')],
        'argoverse2': [
            registration.prepare(in_base(c)) for c in clouds(data / 'argoverse2' / '7fab2350')
        ],
    }
    for (a, matches), (b, queries) in itertools.combinations(sets.items(), 2):
        for (i, match), (j, query) in itertools.product(enumerate(matches), enumerate(queries)):
            yield f'{a}+{b} {i} {j}', match, query
    sweeps = clouds(karlsruhe_out_and_back(work).parents[1])
    for i, cloud in enumerate(itertools.islice(sweeps, 0, None, sweep_step)):
        match = registration.prepare(in_base(cloud))
        for name, others in sets.items():
            for j, query in enumerate(others):
                yield f'karlsruhe+{name} {i * sweep_step} {j}', match, query


def _worst(values: np.ndarray, answered: np.ndarray) -> float | None:
    return float(values[answered].max()) if answered.any() else None
