"""Replay for an hour of recorded time and watch the memory: only the map may grow."""

import gc
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bags.looped import LoopedDrive
from bags.records import Drive
from bags.street import LidarConfig, Route, StreetConfig, StreetDrive
from benchmarks.kitti_folder import write_kitti_folder

if TYPE_CHECKING:
    from rosgraph_msgs.msg import Clock

    from bags.nodes.lockstep import LockStep
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

_SAMPLE_S = 60.0
_IDLE_SAMPLE_S = 15.0
# After the first keyframe no pose is this far or turned this much.
_NO_KEYFRAMES = {'keyframes__distance': 1e6, 'keyframes__angle': 3.15}


@dataclass(frozen=True)
class Growth:
    """What was seen during a replay: at each sample recorded seconds, keyframes, resident bytes."""

    seconds: NDArray[np.float64]
    keyframes: NDArray[np.int64]
    resident: NDArray[np.int64]
    wall_s: float

    @property
    def later(self) -> NDArray[np.bool_]:
        """Which samples are of the second half; before it caches fill up."""
        return self.seconds >= 0.5 * self.seconds[-1]


def circuit() -> StreetDrive:
    """Return a lap around one block that ends where it began, slowly driven."""
    corners = [(30, 0), (70, 0), (70, 55), (0, 55), (0, 0), (30, 0)]
    route = Route(speed=2.0, corner_radius=9.0).through(corners)
    return StreetDrive(route, StreetConfig(seed=3), LidarConfig(columns=360, rate=5.0))


def evaluate(work: Path, recorded_s: float = 3600.0, idle_s: float = 900.0) -> dict[str, Any]:
    """Replay laps in lock-step, with keyframes and, in a process of its own, without.

    Returns memory per keyframe (fitted to the processes' resident size over the second half), what
    grows beside the map, and the keyframes and memory at the end. Keyframes come evenly, so what
    grows with time looks as if it were theirs: that is what the replay without keyframes tells.

    Args:
        work: for the lap.
        recorded_s: recorded time to replay.
        idle_s: the same without keyframes.
    """
    folder = work / 'circuit' / 'sequences' / '00'
    if not (folder / 'calib.txt').is_file():
        write_kitti_folder(circuit(), work / 'circuit')
    growth = replay(folder, recorded_s, _SAMPLE_S)
    with ProcessPoolExecutor(1, mp_context=get_context('spawn')) as pool:
        idle = pool.submit(replay, folder, idle_s, _IDLE_SAMPLE_S, **_NO_KEYFRAMES).result()
    slope, residual = line(growth.keyframes[growth.later], growth.resident[growth.later])
    leak, _ = line(idle.seconds[idle.later] / 3600.0, idle.resident[idle.later])
    return {
        'bytes_per_keyframe': slope,
        'keyframes': int(growth.keyframes[-1]),
        'recorded_s': float(growth.seconds[-1]),
        'wall_s': growth.wall_s,
        'resident_mb': {
            f'after_{round(s / 60)}_min': float(m / 1e6)
            for s, m in zip(growth.seconds, growth.resident, strict=True)
            if round(s / 60) in (1, 10, 20, 30, 40, 50, 60)
        },
        'resident_besides_map_drift_mb': float((residual[-3:].mean() - residual[:3].mean()) / 1e6),
        'without_keyframes_growth_mb_per_hour': leak / 1e6,
        'without_keyframes': {
            'keyframes': int(idle.keyframes[-1]),
            'recorded_s': float(idle.seconds[-1]),
            'wall_s': idle.wall_s,
            'resident_at_half_mb': float(idle.resident[idle.later][0] / 1e6),
            'resident_at_end_mb': float(idle.resident[-1] / 1e6),
        },
    }


def replay(folder: Path, recorded_s: float, every_s: float, **loop_closure: object) -> Growth:
    """Replay laps of a KITTI folder until `recorded_s` of recorded time have passed.

    Args:
        folder: a sequence that ends where it began.
        recorded_s: recorded time to replay.
        every_s: recorded time between two samples.
        loop_closure: parameters of that node, two underscores for a dot.
    """
    from bags.drives import open_drive

    lap: Drive = open_drive(folder)
    truth = lap.truth()
    assert truth is not None
    first_ns = int(truth.stamps_ns[0])
    laps = int(np.ceil(recorded_s / (float(truth.stamps_ns[-1] - first_ns) * 1e-9)))
    samples: list[tuple[float, int, int]] = []
    with _suite(**loop_closure) as (lockstep, pose_graph):

        def sample(message: 'Clock') -> None:
            second = message.clock.sec + message.clock.nanosec * 1e-9 - first_ns * 1e-9
            if not samples or second - samples[-1][0] >= every_s:
                gc.collect()
                samples.append((second, len(pose_graph.map.graph), _resident_bytes()))

        lockstep.listen('/clock', sample)
        start = time.perf_counter()
        lockstep.run(LoopedDrive(lap, laps), duration_s=recorded_s)
        wall_s = time.perf_counter() - start
    seconds, keyframes, resident = zip(*samples, strict=True)
    return Growth(
        np.array(seconds), np.array(keyframes, np.int64), np.array(resident, np.int64), wall_s
    )


def line(x: NDArray[Any], y: NDArray[Any]) -> tuple[float, NDArray[np.float64]]:
    """Return the slope of the least-squares line through y over x, and what y lies above it."""
    columns = np.column_stack([x, np.ones(len(x))])
    found = np.linalg.lstsq(columns, y, rcond=None)[0]
    return float(found[0]), y - columns @ found


@contextmanager
def _suite(**loop_closure: object) -> Iterator[tuple['LockStep', 'PoseGraphNode']]:
    """Yield the three nodes in lock-step, and nothing else that remembers what they said."""
    from bags.nodes.lockstep import LockStep
    from lcd_common.nodes.parameters import overrides
    from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
    from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
    from lcd_loop_closure.nodes.offline_slam import own_context
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode

    with own_context() as context:

        def options(**parameters: object) -> dict[str, Any]:
            given = overrides(threaded=False, **parameters)
            return {
                'context': context,
                'use_global_arguments': False,
                'parameter_overrides': given,
            }

        pose_graph = PoseGraphNode(**options())
        nodes = (
            LidarOdometryNode(**options(threads=0)),
            LoopClosureNode(**options(beside=True, **loop_closure)),
            pose_graph,
        )
        try:
            yield LockStep(nodes), pose_graph
        finally:
            for node in nodes:
                node.destroy_node()


def _resident_bytes() -> int:
    """Return the memory of this process and of its children: loops are looked for in one."""
    tasks = Path('/proc/self/task').iterdir()
    children = [pid for task in tasks for pid in (task / 'children').read_text().split()]
    statm = (Path('/proc') / pid / 'statm' for pid in ('self', *children))
    return sum(4096 * int(path.read_text().split()[1]) for path in statm)
