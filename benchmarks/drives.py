"""Measure whole drives: live through DDS, in lock-step, and beside KISS-SLAM on the same folder."""

import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from bags.drives import open_drive
from bags.records import Drive
from bags.street import StreetConfig, StreetDrive
from benchmarks import peers
from benchmarks.judging import found_share, kiss_slam_figures, link_figures, suite_figures
from benchmarks.kitti_folder import write_kitti_folder
from benchmarks.recordings import karlsruhe_out_and_back
from lcd_common import se3
from lcd_common.errors import LocalizationError
from lcd_common.trajectory import Trajectory, read_poses
from lcd_loop_closure.report.drive_evaluation import evaluate_drive
from lcd_loop_closure.report.evaluation import trajectory_errors
from lcd_loop_closure.report.loop_evaluation import Verdict, judge_loops
from lcd_loop_closure.report.result import DriveResult, corrected_trajectory

# The Karlsruhe sweeps reach 80 m and show the car itself below 3 m.
RANGES: dict[str, dict[str, float]] = {
    'out_and_back': {'max_range': 80.0, 'min_range': 3.0},
    'street': {'max_range': 100.0, 'min_range': 1.0},
    'town': {'max_range': 100.0, 'min_range': 1.5},
}


def out_and_back_live(work: Path) -> dict[str, Any]:
    """Play the real sweeps at 1x to separately started nodes; figures of issue point 6.1."""
    from benchmarks.nodes.live_run import run_live

    sequence = karlsruhe_out_and_back(work)
    bag = work / 'out_and_back_bag'
    if not bag.is_dir():
        bags = str(Path(sys.executable).parent / 'bags')
        subprocess.run([bags, 'convert', str(sequence), '--out', str(bag)], check=True)
    ranges = [f'{name}:={value}' for name, value in RANGES['out_and_back'].items()]
    live = run_live(bag, {'lidar_odometry': ranges}, work / 'live_log')
    recorder = live.recorder
    truth = open_drive(sequence).truth()
    assert truth is not None
    stamps = np.array(sorted(recorder.scan_published_ns), np.int64)
    odometry = _trajectory(recorder.T_odom_base)
    corrected = corrected_trajectory(odometry, _trajectory(recorder.T_map_base()))
    after = trajectory_errors(corrected, truth)
    before = trajectory_errors(odometry, truth)
    keyframe_stamps = np.array(
        [recorder.keyframes[id].stamp_ns for id in sorted(recorder.keyframes)], np.int64
    )
    loops = judge_loops(tuple(recorder.loops()), keyframe_stamps, truth.stamps_ns, truth)
    latencies = np.array(recorder.latencies_ms())
    assert after is not None and before is not None
    return {
        'scans': len(truth.stamps_ns),
        'odometry_lost': len(truth.stamps_ns) - len(recorder.odometry_published_ns),
        'scans_seen_by_recorder': len(stamps),
        'odometry_latency_p50_ms': float(np.percentile(latencies, 50)),
        'odometry_latency_p99_ms': float(np.percentile(latencies, 99)),
        'odometry_latency_max_ms': float(latencies.max()),
        'keyframes': len(recorder.keyframes),
        'loops_found_share': found_share(loops, _turn_ns(truth)),
        'loops_accepted': loops.count(Verdict.TRUE) + loops.count(Verdict.FALSE),
        'loops_wrong': loops.count(Verdict.FALSE),
        'odometry_end_error_m': before.end_error_m,
        'end_error_m': after.end_error_m,
        'ate_m': after.ate_rmse_m,
        'peak_memory_mb': {name: b / 1e6 for name, b in live.peak_memory_bytes.items()},
    }


def out_and_back_lockstep(work: Path) -> dict[str, Any]:
    """Drive the same folder in lock-step with one and with all registration threads."""
    sequence = karlsruhe_out_and_back(work)
    figures: dict[str, Any] = {}
    for name, threads in (('', 0), ('_one_thread', 1)):
        # A process of its own: the first odometry of a process decides on KISS-ICP's threads.
        with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
            found = pool.submit(_lockstep_figures, sequence, work, threads).result()
        figures |= {f'{key}{name}': value for key, value in found.items()}
    return figures


def _lockstep_figures(sequence: Path, work: Path, threads: int) -> dict[str, Any]:
    result = _drive_through(sequence, work, 'out_and_back', threads)
    evaluation = evaluate_drive(result)
    assert evaluation.loops is not None and evaluation.after is not None
    assert result.truth is not None
    return {
        'lockstep_realtime_factor': result.realtime_factor,
        'lockstep_loops_found_share': found_share(evaluation.loops, _turn_ns(result.truth)),
        'lockstep_loops_wrong': evaluation.loops.count(Verdict.FALSE),
        'lockstep_end_error_m': evaluation.after.end_error_m,
    }


def u_turn(work: Path, towns: int = 3) -> dict[str, Any]:
    """Break the odometry by an abrupt U-turn, for the suite and for KISS-SLAM, on several towns.

    The suite's own odometry does not break there. `broken` is what loop closure and pose graph make
    of plain KISS-ICP's, which does and says nothing of it.
    """
    runs = {}
    for seed in range(towns):
        drive = StreetDrive('abrupt_u_turn', settings=StreetConfig(seed=seed))
        sequence = kitti_folder(drive, work / f'u_turn_{seed}')
        peer = _peer(sequence, work, 'street')
        runs[f'town_{seed}'] = {
            **_compared(sequence, work, 'street', peer),
            'broken': _on_odometry_of(peer, sequence),
        }
    broken = [run['broken'] for run in runs.values()]
    return {
        'ate_m': float(np.mean([run['suite']['ate_m'] for run in runs.values()])),
        'kiss_slam_ate_m': float(np.mean([run['kiss_slam']['ate_m'] for run in runs.values()])),
        'broken': {
            key: float(np.mean([b[key] for b in broken]))
            if key.endswith('_m')
            else sum(b[key] for b in broken)
            for key in broken[0]
        },
        **runs,
    }


def side_by_side(work: Path) -> dict[str, Any]:
    """Run suite and KISS-SLAM on the same folders: real out-and-back sweeps and the street loop."""
    folders = {
        'out_and_back': (karlsruhe_out_and_back(work), 'out_and_back'),
        'street_loop': (kitti_folder(StreetDrive('loop'), work / 'street_loop'), 'street'),
    }
    runs = {name: suite_and_peer(at, work, kind) for name, (at, kind) in folders.items()}
    return {
        'kiss_slam': {name: run['kiss_slam'] for name, run in runs.items()},
        'suite': {name: run['suite'] for name, run in runs.items()},
    }


def suite_and_peer(sequence: Path, work: Path, kind: str) -> dict[str, Any]:
    """Return the figures of the suite and of KISS-SLAM on a folder of `kitti_folder`.

    Args:
        sequence: the folder.
        work: for intermediate files.
        kind: 'out_and_back', 'street' or 'town': the ranges that both use.

    Raises:
        PeerError: KISS-SLAM could not be installed or failed.
    """
    return _compared(sequence, work, kind, _peer(sequence, work, kind))


def _peer(sequence: Path, work: Path, kind: str) -> peers.KissSlamRun:
    ranges = RANGES[kind]
    return peers.kiss_slam(sequence, work, ranges['max_range'], ranges['min_range'])


def _compared(sequence: Path, work: Path, kind: str, peer: peers.KissSlamRun) -> dict[str, Any]:
    result = _drive_through(sequence, work, kind, threads=0)
    stamps = result.scan_stamps_ns
    poses = read_poses(sequence.parent.parent / 'poses' / '00.txt')
    return {
        'suite': suite_figures(result, evaluate_drive(result)),
        'kiss_slam': kiss_slam_figures(peer, Trajectory(stamps, poses)),
    }


def _on_odometry_of(peer: peers.KissSlamRun, sequence: Path) -> dict[str, Any]:
    """Return the figures of the suite on the peer's odometry."""
    from benchmarks.nodes.given_odometry import drive_on

    drive = open_drive(sequence)
    truth = drive.truth()
    assert truth is not None
    T_base_lidar = next(m.T_parent_child for m in drive.mountings if m.child == 'lidar')
    T_odom_base = T_base_lidar @ peer.T_odom_lidar @ se3.inverse(T_base_lidar)
    poses = dict(zip(truth.stamps_ns.tolist(), T_odom_base, strict=True))
    result, given_up = drive_on(poses, drive, source='odometry of KISS-ICP')
    figures = suite_figures(result, evaluate_drive(result))
    del figures['ms_per_scan']  # without odometry it says nothing
    return {**figures, **link_figures(result, given_up)}


def _drive_through(sequence: Path, work: Path, kind: str, threads: int) -> DriveResult:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    parameters = work / f'{kind}.yaml'
    lines = ''.join(f'    {name}: {value}\n' for name, value in RANGES[kind].items())
    parameters.write_text(f'/lidar_odometry:\n  ros__parameters:\n{lines}')
    return drive_through(
        open_drive(sequence), threads=threads, parameter_files=[parameters], source=kind
    )


def kitti_folder(drive: Drive, root: Path) -> Path:
    """Return a drive's sequence folder in KITTI's layout, written unless it is there."""
    sequence = root / 'sequences' / '00'
    return sequence if (sequence / 'calib.txt').is_file() else write_kitti_folder(drive, root)


def _trajectory(T_by_stamp: Mapping[int, se3.Array]) -> Trajectory:
    stamps = sorted(T_by_stamp)
    if not stamps:
        raise LocalizationError('the live run published no poses; see the logs of the nodes')
    return Trajectory(np.array(stamps, np.int64), np.array([T_by_stamp[s] for s in stamps]))


def _turn_ns(truth: Trajectory) -> int:
    """Return when the vehicle is farthest from its start: there it turns back."""
    away = np.linalg.norm(truth.positions - truth.positions[0], axis=1)
    return int(truth.stamps_ns[int(np.argmax(away))])
