"""Read the sweeps of any drive, with their true poses, into a store."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.records import Drive, LidarScan
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, SweepWriter
from lcd_loop_closure.report.reference import Reference, mounting_in_base

Progress = Callable[[int, int], None]


def store_drive(
    drive: Drive,
    folder: Path,
    *,
    spacing_m: float = 0.0,
    reference: Reference | None = None,
    T_base_body: se3.Array | None = None,
    progress: Progress = lambda done, total: None,
) -> StoredSweeps:
    """Write the sweeps of a drive that have a true pose; return them.

    Args:
        drive: to read.
        folder: for the store.
        spacing_m: path between two sweeps at least; 0 takes all, as the thesis does.
        reference: of the poses, where the drive has none of its own or others are wanted.
        T_base_body: of the frame whose poses the reference has; None: base_link's.
        progress: told how many sweeps are done of how many there are.

    Raises:
        DataError: there is no truth, or no sweep with a true pose.
    """
    truth = drive.truth() if reference is None else None
    if truth is None and reference is None:
        raise DataError(
            f'{drive.path}: has no ground truth, so nothing can be judged; give --truth with TUM '
            'or KITTI poses'
        )
    wanted = None if truth is None or spacing_m <= 0.0 else _spaced_stamps(truth, spacing_m)
    total = len(wanted) if wanted is not None else _scans(drive)
    with SweepWriter(folder, drive.name, {'spacing_m': spacing_m}) as writer:
        for scan in _read(drive, wanted):
            T_world_base = np.eye(4) if truth is None else truth.at(scan.stamp_ns)
            if T_world_base is None:
                continue
            cloud = scan.cloud.transformed(mounting_in_base(drive.mountings, scan.frame_id))
            writer.add(scan.stamp_ns, cloud, T_world_base)
            progress(len(writer), total)
    sweeps = StoredSweeps(folder)
    if not len(sweeps):
        raise DataError(f'{drive.path}: no sweep has a true pose; compare the times of both')
    if reference is None:
        return sweeps
    T_body_base = se3.inverse(np.eye(4) if T_base_body is None else T_base_body)
    return referred(sweeps, reference.trajectory(sweeps.stamps_ns, T_body_base), spacing_m)


def referred(sweeps: StoredSweeps, truth: Trajectory, spacing_m: float = 0.0) -> StoredSweeps:
    """Return the sweeps that a reference has a pose for, with these poses.

    Raises:
        DataError: there is none.
    """
    found = [(k, truth.at(int(stamp))) for k, stamp in enumerate(sweeps.stamps_ns)]
    poses = np.array([T for _, T in found if T is not None]).reshape(-1, 4, 4)
    if not len(poses):
        raise DataError(f'{sweeps.name}: no sweep lies within the times of the reference poses')
    chosen = np.array([k for k, T in found if T is not None], np.intp)
    kept = spaced(poses, spacing_m)
    return sweeps.select(chosen[kept]).with_poses(poses[kept])


def spaced(T_world_base: se3.Array, spacing_m: float) -> NDArray[np.intp]:
    """Return the poses [K] that lie at least so far from the one kept before; the first is kept."""
    kept, positions = [0], T_world_base[:, :3, 3]
    for k in range(1, len(positions)):
        # A little less than asked: sweeps come every metre, not every metre and a millimetre.
        if np.linalg.norm(positions[k] - positions[kept[-1]]) >= 0.95 * spacing_m:
            kept.append(k)
    return np.array(kept if len(positions) else [], np.intp)


def _spaced_stamps(truth: Trajectory, spacing_m: float) -> NDArray[np.int64]:
    return truth.stamps_ns[spaced(truth.T_world_body, spacing_m)]


def _scans(drive: Drive) -> int:
    return max((s.count for s in drive.streams() if s.type_name.endswith('PointCloud2')), default=0)


def _read(drive: Drive, wanted: NDArray[np.int64] | None) -> Iterator[LidarScan]:
    from bags.simulation.drive import SimulatedDrive  # scipy: not before it is needed

    if wanted is not None and isinstance(drive, SimulatedDrive):
        # A simulated sweep costs its rendering: only those wanted are asked for.
        for stamp in wanted:
            for record in drive.records(int(stamp), int(stamp), [LidarScan]):
                if isinstance(record, LidarScan):
                    yield record
        return
    nearest = None if wanted is None else set(wanted.tolist())
    for record in drive.records(kinds=[LidarScan]):
        assert isinstance(record, LidarScan)
        if nearest is None or record.stamp_ns in nearest:
            yield record
