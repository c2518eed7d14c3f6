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
from bags.street import StreetConfig, StreetDrive
from benchmarks import peers
from benchmarks.judging import found_share, kiss_slam_figures, suite_figures
from benchmarks.kitti_folder import write_kitti_folder
from benchmarks.recordings import karlsruhe_out_and_back
from lcd_common import se3
from lcd_common.errors import LocalizationError
from lcd_common.trajectory import Trajectory, read_poses
from lcd_loop_closure.report.drive_evaluation import evaluate_drive
from lcd_loop_closure.report.evaluation import trajectory_errors
from lcd_loop_closure.report.loop_evaluation import Verdict, judge_loops
from lcd_loop_closure.report.result import DriveResult, corrected_trajectory

# Stated in the results: the Karlsruhe sweeps reach 80 m and show the car itself below 3 m.
_RANGES: dict[str, dict[str, float]] = {
    'out_and_back': {'max_range': 80.0, 'min_range': 3.0},
    'street': {'max_range': 100.0, 'min_range': 1.0},
}


def out_and_back_live(work: Path) -> dict[str, Any]:
    """Play the real sweeps at 1x to separately started nodes; figures of issue point 6.1."""
    from benchmarks.nodes.live_run import run_live

    sequence = karlsruhe_out_and_back(work)
    bag = work / 'out_and_back_bag'
    if not bag.is_dir():
        bags = str(Path(sys.executable).parent / 'bags')
        subprocess.run([bags, 'convert', str(sequence), '--out', str(bag)], check=True)
    ranges = [f'{name}:={value}' for name, value in _RANGES['out_and_back'].items()]
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
    """Break the odometry by an abrupt U-turn, for the suite and for KISS-SLAM, on several towns."""
    runs = {}
    for seed in range(towns):
        drive = StreetDrive('abrupt_u_turn', settings=StreetConfig(seed=seed))
        sequence = _street_folder(drive, work / f'u_turn_{seed}')
        runs[f'town_{seed}'] = _side_by_side(sequence, work, 'street')
    return {
        'ate_m': float(np.mean([run['suite']['ate_m'] for run in runs.values()])),
        'kiss_slam_ate_m': float(np.mean([run['kiss_slam']['ate_m'] for run in runs.values()])),
        **runs,
    }


def side_by_side(work: Path) -> dict[str, Any]:
    """Run suite and KISS-SLAM on the same folders: real out-and-back sweeps and the street loop."""
    folders = {
        'out_and_back': (karlsruhe_out_and_back(work), 'out_and_back'),
        'street_loop': (_street_folder(StreetDrive('loop'), work / 'street_loop'), 'street'),
    }
    runs = {name: _side_by_side(at, work, kind) for name, (at, kind) in folders.items()}
    return {
        'kiss_slam': {name: run['kiss_slam'] for name, run in runs.items()},
        'suite': {name: run['suite'] for name, run in runs.items()},
    }


def _side_by_side(sequence: Path, work: Path, kind: str) -> dict[str, Any]:
    result = _drive_through(sequence, work, kind, threads=0)
    ranges = _RANGES[kind]
    peer = peers.kiss_slam(sequence, work, ranges['max_range'], ranges['min_range'])
    stamps = result.scan_stamps_ns
    poses = read_poses(sequence.parent.parent / 'poses' / '00.txt')
    return {
        'suite': suite_figures(result, evaluate_drive(result)),
        'kiss_slam': kiss_slam_figures(peer, Trajectory(stamps, poses)),
    }


def _drive_through(sequence: Path, work: Path, kind: str, threads: int) -> DriveResult:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    parameters = work / f'{kind}.yaml'
    lines = ''.join(f'    {name}: {value}\n' for name, value in _RANGES[kind].items())
    parameters.write_text(f'/lidar_odometry:\n  ros__parameters:\n{lines}')
    return drive_through(
        open_drive(sequence), threads=threads, parameter_files=[parameters], source=kind
    )


def _street_folder(drive: StreetDrive, root: Path) -> Path:
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
