"""MapClosures on the sweeps that every other method is judged on."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.loop_pairs import T_BASE_LIDAR
from benchmarks.peer_candidates import judged, map_closures
from lcd_common import se3
from lcd_loop_closure.evaluation.detection_protocols import (
    Candidates,
    PrecisionRecall,
    protocol_1,
)
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps


def judge_map_closures(
    work: Path, sweeps: StoredSweeps, reverse: NDArray[np.bool_], kind: str
) -> PrecisionRecall:
    """Return MapClosures' curve by protocol 1, in an environment of its own.

    It compares local maps, not pairs of scans, so there is no protocol 2.

    Args:
        work: folder for the sweeps in KITTI's layout, removed again.
        sweeps: to judge.
        reverse: [Q] as `Detection.reverse` of the same sweeps.
        kind: class of the revisits, same_way or reverse.
    """
    found = map_closure_candidates(work, sweeps)
    return protocol_1(found.select(~found.loop | (reverse if kind == 'reverse' else ~reverse)))


def map_closure_candidates(work: Path, sweeps: StoredSweeps) -> Candidates:
    """Return which earlier sweep each one shows by MapClosures; see `judge_map_closures`."""
    root = work / f'kitti_{sweeps.name}'
    T_world_lidar = sweeps.T_world_base @ T_BASE_LIDAR
    try:
        run = map_closures(_kitti_sequence(sweeps, T_world_lidar, root), work)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    return judged(run, T_world_lidar)


def _kitti_sequence(sweeps: StoredSweeps, T_world_lidar: se3.Array, root: Path) -> Path:
    sequence = root / 'sequences' / '00'
    (sequence / 'velodyne').mkdir(parents=True, exist_ok=True)
    (root / 'poses').mkdir(exist_ok=True)
    T_lidar_base = se3.inverse(T_BASE_LIDAR)
    for number in range(len(sweeps)):
        xyz = sweeps.cloud(number).transformed(T_lidar_base).xyz
        points = np.zeros((len(xyz), 4), np.float32)
        points[:, :3] = xyz
        points.tofile(sequence / 'velodyne' / f'{number:06d}.bin')
    poses = se3.inverse(T_world_lidar[0]) @ T_world_lidar
    np.savetxt(root / 'poses' / '00.txt', poses[:, :3].reshape(-1, 12), fmt='%.9e')
    return sequence
