"""Compose the three nodes in lock-step over a drive and collect what they say."""

import os
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.context import Context
from sensor_msgs.msg import PointCloud2

from bags.nodes.lockstep import LockStep
from bags.records import Drive
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import overrides
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.map_exports import measured
from lcd_loop_closure.nodes.conversions import loop_from_message
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from lcd_loop_closure.report.result import DriveResult
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage
from lcd_msgs.msg import LoopConstraintArray

# After the last scan the clock goes on, so that timers bring the last verdict and the last counts.
_AFTERWARDS_S = 5


class OfflineSlam:
    """Odometry, loop closure and pose graph in one process, fed by hand, listened to."""

    def __init__(
        self,
        context: Context,
        parameter_files: Sequence[Path],
        threads: int | None,
        detector: str | None = None,
    ) -> None:
        """Make the nodes.

        Args:
            context: that they live in.
            parameter_files: ROS parameter files; what lock-step needs holds above them.
            threads: of registration, 0 is all cores; None is what the parameter files say. But for
                one thread, loops are looked for in a process beside.
            detector: what describes places; None is what the parameter files say.

        Raises:
            ConfigError: a parameter has the wrong type or lies out of its range.
        """
        files = [word for path in parameter_files for word in ('--params-file', str(path))]
        cli_args = ['--ros-args', *files] if files else []

        def options(**parameters: object) -> dict[str, object]:
            return {
                'context': context,
                'cli_args': cli_args,
                'use_global_arguments': False,
                'parameter_overrides': overrides(threaded=False, **parameters),
            }

        given = {} if threads is None else {'threads': threads}
        self.odometry = LidarOdometryNode(**options(**given))
        beside = self.odometry.get_parameter('threads').value != 1
        chosen: dict[str, object] = {'beside': beside}
        if detector is not None:
            chosen['descriptor__method'] = detector
        if threads is not None and not beside:
            chosen['lcdnet__threads'] = threads
        self.loop_closure = LoopClosureNode(**options(**chosen))
        self.pose_graph = PoseGraphNode(**options())
        self.nodes = (self.odometry, self.loop_closure, self.pose_graph)
        self.lockstep = LockStep(self.nodes)
        self.stage_times_ms: dict[str, dict[str, list[float]]] = {}
        for node in self.nodes:
            self._time_stages(node.get_fully_qualified_name(), node.diagnostics)
        self._scan_stamps: list[int] = []
        self._T_odom_base: dict[int, se3.Array] = {}
        self._loops: dict[tuple[int, int, str], LoopConstraint] = {}
        self._judged: LoopConstraintArray | None = None
        self._map: PointCloud2 | None = None
        self.lockstep.listen('/points', self._on_points)
        self.lockstep.listen('/odom', self._on_odom)
        self.lockstep.listen('/loop_constraint', self._on_loop)
        self.lockstep.listen('/loops', self._on_loops)
        self.lockstep.listen('/map', self._on_map)

    def drive(
        self, drive: Drive, start_s: float, duration_s: float | None, progress: bool
    ) -> tuple[float, bool]:
        """Replay a drive; return the seconds that it took, and whether Ctrl-C ended it."""
        begin, interrupted = time.perf_counter(), False
        try:
            self.lockstep.run(drive, start_s=start_s, duration_s=duration_s, progress=progress)
        except KeyboardInterrupt:
            interrupted = True
            self.lockstep.flush()
        self.pose_graph.show(map_cloud=True)
        if self._scan_stamps:
            for second in range(1, _AFTERWARDS_S + 1):
                self.lockstep.set_time(self._scan_stamps[-1] + second * 1_000_000_000)
        return time.perf_counter() - begin, interrupted

    def result(self, drive: Drive, source: str, wall_s: float, interrupted: bool) -> DriveResult:
        """Return everything that the nodes have said and hold, free of ROS."""
        for judged in () if self._judged is None else self._judged.loops:
            self._remember(loop_from_message(judged))
        graph = self.pose_graph.map.graph.snapshot()
        scans = np.array(self._scan_stamps, np.int64)
        stamps = np.array(sorted(self._T_odom_base), np.int64)
        poses = np.array([self._T_odom_base[int(stamp)] for stamp in stamps]).reshape(-1, 4, 4)
        return DriveResult(
            name=drive.name,
            source=source,
            odometry=Trajectory(stamps, poses),
            keyframes=Trajectory(graph.stamps_ns, graph.T_map_base),
            loops=tuple(sorted(self._loops.values(), key=lambda loop: loop.query_stamp_ns)),
            truth=drive.truth(),
            map_cloud=None if self._map is None else messages.cloud_from_message(self._map),
            graph=measured(graph) if len(graph) else None,
            stage_times_ms=self.stage_times_ms,
            counts={
                node.get_fully_qualified_name(): dict(sorted(node.diagnostics.counts().items()))
                for node in self.nodes
            },
            skipped=dict(drive.skipped),
            scan_stamps_ns=scans,
            recorded_s=float(scans[-1] - scans[0]) * 1e-9 if len(scans) else 0.0,
            wall_s=wall_s,
            interrupted=interrupted,
        )

    def _time_stages(self, node: str, diagnostics: Diagnostics) -> None:
        stages: dict[str, list[float]] = defaultdict(list)
        self.stage_times_ms[node] = stages
        diagnostics.on_time = lambda stage, seconds: stages[stage].append(1e3 * seconds)

    def _on_points(self, message: PointCloud2) -> None:
        self._scan_stamps.append(messages.stamp_ns(message.header.stamp))

    def _on_odom(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self._T_odom_base[stamp_ns] = messages.transform_from_pose(message.pose.pose)

    def _on_loop(self, message: LoopConstraintMessage) -> None:
        self._remember(loop_from_message(message))

    def _on_loops(self, message: LoopConstraintArray) -> None:
        self._judged = message  # all loops each time: only the last one counts

    def _remember(self, loop: LoopConstraint) -> None:
        key = loop.match_id, loop.query_id, loop.method
        before = self._loops.get(key)
        if before is not None:
            # The graph's word is the last, but it may not repeat how the loop was found.
            loop = replace(before, status=loop.status, reason=loop.reason or before.reason)
        self._loops[key] = loop

    def _on_map(self, message: PointCloud2) -> None:
        self._map = message  # converted at the end: only the last one counts


def drive_through(
    drive: Drive,
    *,
    source: str,
    start_s: float = 0.0,
    duration_s: float | None = None,
    threads: int | None = None,
    detector: str | None = None,
    parameter_files: Sequence[Path] = (),
    progress: bool = True,
) -> DriveResult:
    """Drive a recording through new nodes and return what they made of it.

    Ctrl-C ends the drive early; what was driven until then is returned.

    Args:
        drive: the recording.
        source: where it came from, in the user's words.
        start_s: seconds of the drive to leave out at its beginning.
        duration_s: seconds to drive; None is to the end.
        threads: of registration, 0 is all cores, one repeats exactly; None: as the files say.
        detector: 'lcdnet' or 'scan_context'; None: as the files say.
        parameter_files: ROS parameter files for the nodes.
        progress: show a bar on stderr.

    Raises:
        ConfigError: a parameter is wrong.
        DataError: the drive cannot be read.
    """
    with own_context() as context:
        slam = OfflineSlam(context, parameter_files, threads, detector)
        try:
            wall_s, interrupted = slam.drive(drive, start_s, duration_s, progress)
            return slam.result(drive, source, wall_s, interrupted)
        finally:
            for node in slam.nodes:
                node.destroy_node()


@contextmanager
def own_context() -> Iterator[Context]:
    """Yield an initialised ROS context that leaves Ctrl-C alone and that nobody else sees."""
    context = Context()
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    before = os.environ.get(name)
    os.environ[name] = 'OFF'  # the nodes of a robot nearby must not meet these
    try:
        rclpy.init(args=[], context=context)
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
    try:
        yield context
    finally:
        context.try_shutdown()
