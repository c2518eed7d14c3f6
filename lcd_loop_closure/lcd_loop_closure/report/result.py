"""Hold everything that a drive through the nodes left behind, free of ROS."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.g2o import MeasuredGraph
from lcd_loop_closure.loop import LoopConstraint


@dataclass(frozen=True)
class DriveResult:
    """What one drive gave.

    Attributes:
        name: of the drive, for titles.
        source: where it came from, as the user named it.
        odometry: T_odom_base of every scan that odometry registered.
        keyframes: T_map_base of every keyframe by the pose graph's last word.
        loops: every candidate with its latest verdict, in the order of their queries.
        truth: T_world_base in the reference's own world, or None.
        map_cloud: corrected map in the map frame, or None.
        graph: poses, odometry's links and the loops that hold, or None.
        stage_times_ms: node -> stage -> milliseconds of every run of that stage.
        counts: node -> cause -> how often it was counted (rejected inputs, drops).
        skipped: what the reader could not read, by cause.
        scan_stamps_ns: [N] stamps of every scan that was offered, registered or not.
        recorded_s: time that the driven part of the recording spans.
        wall_s: time that the nodes took for it, reading of the files included.
        interrupted: True when the user stopped it before its end.
    """

    name: str
    source: str
    odometry: Trajectory
    keyframes: Trajectory
    loops: tuple[LoopConstraint, ...] = ()
    truth: Trajectory | None = None
    map_cloud: PointCloud | None = None
    graph: MeasuredGraph | None = None
    stage_times_ms: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)
    counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    skipped: Mapping[str, int] = field(default_factory=dict)
    scan_stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    recorded_s: float = 0.0
    wall_s: float = 0.0
    interrupted: bool = False

    @property
    def accepted(self) -> tuple[LoopConstraint, ...]:
        """Loops that hold in the graph."""
        return tuple(loop for loop in self.loops if loop.accepted)

    @property
    def realtime_factor(self) -> float | None:
        """How many times faster than recorded; None when the recording has no duration."""
        return self.recorded_s / self.wall_s if self.recorded_s > 0 and self.wall_s > 0 else None

    def corrected(self) -> Trajectory:
        """Return T_map_base of every scan: keyframes as the graph has them, odometry in between."""
        return corrected_trajectory(self.odometry, self.keyframes)

    def with_truth(self, truth: Trajectory | None) -> 'DriveResult':
        """Return the same result judged by another reference."""
        return replace(self, truth=truth)


def corrected_trajectory(odometry: Trajectory, keyframes: Trajectory) -> Trajectory:
    """Carry the keyframes' corrections over to every pose of odometry.

    Between two keyframes both corrections are applied and blended along the way, so that the
    trajectory passes through both keyframes and bends evenly in between.

    Args:
        odometry: T_odom_base of every scan.
        keyframes: T_map_base of the keyframes; stamps that odometry does not cover are left out.
    """
    known = [odometry.at(int(stamp)) for stamp in keyframes.stamps_ns]
    T_map_odom = [
        T_map_base @ se3.inverse(T_odom_base)
        for T_map_base, T_odom_base in zip(keyframes.T_world_body, known, strict=True)
        if T_odom_base is not None
    ]
    if not T_map_odom:
        return odometry
    stamps = keyframes.stamps_ns[[T is not None for T in known]]
    poses = np.empty_like(odometry.T_world_body)
    after = np.searchsorted(stamps, odometry.stamps_ns, side='right')
    for k, (stamp, right) in enumerate(zip(odometry.stamps_ns, after, strict=True)):
        T_odom_base = odometry.T_world_body[k]
        left = max(int(right) - 1, 0)
        poses[k] = T_map_odom[left] @ T_odom_base
        if 0 < right < len(stamps) and stamp > stamps[left]:
            share = float(stamp - stamps[left]) / float(stamps[right] - stamps[left])
            poses[k] = se3.interpolate(poses[k], T_map_odom[right] @ T_odom_base, share)
    return Trajectory(odometry.stamps_ns, poses)
