"""Replay for an hour of recorded time and watch the memory: only the map may grow."""

import gc
from pathlib import Path
from typing import Any

import numpy as np
from rosgraph_msgs.msg import Clock

from bags.looped import LoopedDrive
from bags.records import Drive
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from benchmarks.kitti_folder import write_kitti_folder

_SAMPLE_S = 60.0


def circuit() -> StreetDrive:
    """Return a lap around one block that ends where it began, slowly driven."""
    corners = [(30, 0), (70, 0), (70, 55), (0, 55), (0, 0), (30, 0)]
    route = Route(speed=2.0, corner_radius=9.0).through(corners)
    return StreetDrive(route, StreetConfig(seed=3), LidarConfig(columns=360, rate=5.0))


def evaluate(work: Path, recorded_s: float = 3600.0) -> dict[str, Any]:
    """Replay laps in lock-step until `recorded_s` of recorded time have passed.

    Returns memory per keyframe (fitted to the processes' resident size over the second half), what
    grows beside the map, and the keyframes and memory at the end.
    """
    from bags.drives import open_drive
    from lcd_loop_closure.nodes.offline_slam import OfflineSlam, own_context

    folder = work / 'circuit' / 'sequences' / '00'
    if not (folder / 'calib.txt').is_file():
        write_kitti_folder(circuit(), work / 'circuit')
    lap: Drive = open_drive(folder)
    truth = lap.truth()
    assert truth is not None
    lap_s = float(truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9
    laps = int(np.ceil(recorded_s / lap_s))
    samples: list[tuple[float, int, int]] = []
    with own_context() as context:
        slam = OfflineSlam(context, [], threads=0)
        first_ns = int(truth.stamps_ns[0])

        def sample(message: Clock) -> None:
            second = message.clock.sec + message.clock.nanosec * 1e-9 - first_ns * 1e-9
            if not samples or second - samples[-1][0] >= _SAMPLE_S:
                gc.collect()
                samples.append((second, len(slam.pose_graph.map.graph), _resident_bytes()))

        slam.lockstep.listen('/clock', sample)
        wall_s, _ = slam.drive(LoopedDrive(lap, laps), 0.0, recorded_s, True)
        for node in slam.nodes:
            node.destroy_node()
    seconds, keyframes, resident = np.array(samples, np.float64).T
    later = seconds >= 0.5 * seconds[-1]
    columns = np.column_stack([keyframes[later], np.ones(later.sum())])
    slope, base = np.linalg.lstsq(columns, resident[later], rcond=None)[0]
    residual = resident[later] - columns @ [slope, base]
    return {
        'bytes_per_keyframe': float(slope),
        'keyframes': int(keyframes[-1]),
        'recorded_s': float(seconds[-1]),
        'wall_s': wall_s,
        'resident_mb': {
            f'after_{round(s / 60)}_min': float(m / 1e6)
            for s, m in zip(seconds, resident, strict=True)
            if round(s / 60) in (1, 10, 20, 30, 40, 50, 60)
        },
        'resident_besides_map_drift_mb': float((residual[-3:].mean() - residual[:3].mean()) / 1e6),
    }


def _resident_bytes() -> int:
    """Return the memory of this process and of its children: loops are looked for in one."""
    tasks = Path('/proc/self/task').iterdir()
    children = [pid for task in tasks for pid in (task / 'children').read_text().split()]
    statm = (Path('/proc') / pid / 'statm' for pid in ('self', *children))
    return sum(4096 * int(path.read_text().split()[1]) for path in statm)
