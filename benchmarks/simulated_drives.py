"""Drives through simulated towns: how hard, how much drift, and live."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bags.inputs import open_input
from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.held_out import TEST_SETS
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.stream import TEST_SEEDS
from benchmarks.drives import RANGES, kitti_folder, suite_and_peer
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.evaluation.detection_protocols import PrecisionRecall, candidates, protocol_1
from lcd_loop_closure.revisits import count_revisits
from lcd_loop_closure.scan_context import ScanContext, ScanContextConfig

_HEIGHT_M = 1.73
_MEAN_SPEED_M_S = 6.3  # of the simulated journeys, stops included
SPACING_M = 1.0  # KITTI's cars take a scan a metre


def scan_context(work: Path, towns: int | None = None) -> dict[str, Any]:
    """Return Scan Context's average precision by protocol 1 on every test set."""
    del work
    figures: dict[str, Any] = {}
    for name, held_out in TEST_SETS.items():
        curves = {}
        for town, drive in held_out.drives(towns).items():
            curve, places = judge(drive)
            curves[town] = {'average_precision': curve.average_precision, **places}
        figures[name] = float(np.mean([c['average_precision'] for c in curves.values()]))
        figures[f'{name}_by_town'] = curves
    return {'scan_context_ap': figures}


def judge(drive: SimulatedDrive) -> tuple[PrecisionRecall, dict[str, float]]:
    """Describe a drive by Scan Context; return its curve and how distinct its places are.

    The latter are medians over scans that return to a place: of the distance to the nearest scan of
    that place, to the most similar scan of another place (more than 20 m away), and to any other
    place; and the share of them that another place is more like (perceptual aliasing).
    """
    descriptor = ScanContext(ScanContextConfig())
    kept, poses = spaced(drive)
    rows = []
    for index in kept:
        xyz = drive.sweep(index).cloud.xyz + np.array([0.0, 0.0, _HEIGHT_M], np.float32)
        rows.append(descriptor.row(descriptor.describe(PointCloud(xyz))))
    table = np.array(rows)
    found = candidates(lambda i, m: descriptor.compare(table[i], table[:m])[0], poses[:, :3, 3])
    within, nearest_other, between = [], [], []
    for query in found.query[found.loop]:
        earlier = int(query) - 50
        distance = descriptor.compare(table[query], table[:earlier])[0]
        away = np.linalg.norm(poses[:earlier, :3, 3] - poses[query, :3, 3], axis=1)
        within.append(distance[away <= 4.0].min())
        nearest_other.append(distance[away > 20.0].min())
        between.append(np.median(distance[away > 20.0]))
    return protocol_1(found), {
        'loops': count_revisits(poses).loops,
        'distance_within_a_place': float(np.median(within)),
        'distance_to_most_similar_other_place': float(np.median(nearest_other)),
        'distance_between_places': float(np.median(between)),
        'aliased_share': float(np.mean(np.array(nearest_other) < np.array(within))),
    }


def spaced(drive: SimulatedDrive) -> tuple[list[int], se3.Array]:
    """Return sweeps at least a metre apart, and their poses."""
    poses = drive.truth().T_world_body
    kept = [0]
    for index in range(1, len(poses)):
        if np.linalg.norm(poses[index, :3, 3] - poses[kept[-1], :3, 3]) >= 0.95 * SPACING_M:
            kept.append(index)
    return kept, poses[kept]


def kiss_icp(work: Path, towns: int = 3, length_m: float = 1200.0) -> dict[str, Any]:
    """Return KISS-ICP's drift on simulated drives by KITTI's metric, percent.

    With the calibration errors of KITTI's sensor; beside it, on one town, without them.
    """
    del work
    drifts = {
        f'town_{seed}': _kiss_icp_drift(seed, 'hdl64_kitti', length_m)
        for seed in TEST_SEEDS[:towns]
    }
    return {
        'kiss_icp_drift_percent': float(np.mean([d['percent'] for d in drifts.values()])),
        'kiss_icp': {
            **drifts,
            'well_calibrated': _kiss_icp_drift(TEST_SEEDS[0], 'hdl64', length_m),
        },
    }


def _kiss_icp_drift(seed: int, lidar: str, length_m: float) -> dict[str, float]:
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP
    from kiss_icp.metrics import sequence_error

    sensors = SensorsConfig(lidar=lidar)
    drive = SimulatedDrive(seed, journey=JourneyConfig(length=length_m), sensors=sensors)
    settings, ranges = load_config(None), RANGES['town']
    settings.data.max_range, settings.data.min_range = ranges['max_range'], ranges['min_range']
    settings.data.deskew, settings.mapping.voxel_size = False, 1.0
    odometry = KissICP(settings)
    truth = drive.truth().T_world_body
    poses: list[NDArray[np.float64]] = []
    for index in range(len(truth)):
        xyz = drive.sweep(index).cloud.xyz.astype(np.float64)
        odometry.register_frame(xyz, np.empty(0))
        poses.append(odometry.last_pose.copy())
    mounted = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, _HEIGHT_M])
    drift, rotation = sequence_error([T @ mounted for T in truth], poses)
    return {'percent': float(drift), 'deg_per_m': float(rotation)}


def kiss_slam(work: Path, length_m: float = 1200.0) -> dict[str, Any]:
    """Run the suite and KISS-SLAM on one drive through a test town, written as a KITTI folder."""
    seed = TEST_SEEDS[0]
    lidar_alone = SensorsConfig(lidar='hdl64_kitti', imu='', gnss=False)
    drive = SimulatedDrive(seed, journey=JourneyConfig(length=length_m), sensors=lidar_alone)
    sequence = kitti_folder(drive, work / f'town_{seed}_{length_m:.0f}m')
    truth = drive.truth()
    return {
        'kiss_slam': {
            'town': seed,
            'scans': len(truth.stamps_ns),
            'path_m': truth.length_m,
            **suite_and_peer(sequence, work, 'town'),
        }
    }


def live(work: Path, seconds: float = 600.0) -> dict[str, Any]:
    """Play a simulated 10 Hz drive at 1x through DDS to the three nodes."""
    from benchmarks.nodes.live_run import run_live

    bag = work / f'town_{seconds:.0f}s'
    if not bag.is_dir():
        bags = str(Path(sys.executable).parent / 'bags')
        subprocess.run(
            [bags, 'simulate', '--town', str(TEST_SEEDS[0]), '--out', str(bag),
             '--length', f'{_MEAN_SPEED_M_S * seconds:.0f}'],
            check=True,
        )  # fmt: skip
    result = run_live(bag, {'lidar_odometry': ['min_range:=2.0']}, work / 'town_live_log')
    recorder = result.recorder
    scans = next(one.count for one in open_input(bag).streams() if one.topic.endswith('points'))
    latencies = np.array(recorder.latencies_ms())
    return {
        'live_10hz': {
            'scans': scans,
            'seconds': 0.1 * scans,
            'odometry_lost': scans - len(recorder.odometry_published_ns),
            'odometry_latency_p50_ms': float(np.percentile(latencies, 50)),
            'odometry_latency_p99_ms': float(np.percentile(latencies, 99)),
            'keyframes': len(recorder.keyframes),
            'loops_accepted': sum(loop.status.name == 'ACCEPTED' for loop in recorder.loops()),
        }
    }
