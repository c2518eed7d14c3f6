"""A drive without sensors: an eight of two rounds, odometry that drifts, loops right and wrong."""

from dataclasses import replace

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.g2o import MeasuredGraph
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.report.result import DriveResult

SCANS, PERIOD_NS, EVERY = 800, 100_000_000, 4
START_NS = 1_700_000_000_123_456_789


@pytest.fixture(scope='session')
def truth() -> Trajectory:
    """Two rounds (with the same positions) of an eight, 80 s, from the origin along x."""
    angle = np.linspace(0, 4 * np.pi, SCANS)
    x, y = 60 * np.sin(angle), 40 * np.sin(angle) * np.cos(angle)
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    poses = np.array(
        [
            se3.from_rotation_translation(se3.so3_exp([0, 0, h]), [a, b, 0.02 * a])
            for a, b, h in zip(x, y, heading, strict=True)
        ]
    )
    poses = se3.inverse(poses[0]) @ poses
    return Trajectory(START_NS + PERIOD_NS * np.arange(SCANS), poses)


@pytest.fixture(scope='session')
def odometry(truth: Trajectory) -> Trajectory:
    """The same drive with a scale error of 1 % and a turning error of 0.01 deg a scan."""
    error = se3.exp([0, 0, 0, 0, 0, np.radians(0.01)])
    poses = [truth.T_world_body[0]]
    for previous, this in zip(truth.T_world_body[:-1], truth.T_world_body[1:], strict=True):
        motion = se3.inverse(previous) @ this
        motion[:3, 3] *= 1.01
        poses.append(poses[-1] @ motion @ error)
    return Trajectory(truth.stamps_ns, np.array(poses))


@pytest.fixture(scope='session')
def result(truth: Trajectory, odometry: Trajectory) -> DriveResult:
    """A result whose graph is nearly right: 20 true loops, 2 false ones, some rejected."""
    rng = np.random.default_rng(0)
    index = np.arange(0, SCANS, EVERY)
    noisy = np.array(
        [
            truth.T_world_body[k] @ se3.exp(rng.normal(0, [0.05, 0.05, 0.02, 0, 0, 0.001]))
            for k in index
        ]
    )
    loops = []
    for number in range(25):
        query = 400 + 12 * number
        loops.append(_loop(truth, query - 400, query))
    loops[3] = replace(
        loops[3], status=LoopStatus.REJECTED_FITNESS, reason='fitness 0.31, at least 0.6'
    )
    loops[4] = replace(
        loops[4], status=LoopStatus.REJECTED_BY_GRAPH, reason='outlier of the robust solve'
    )
    loops[5] = replace(
        loops[5], status=LoopStatus.REJECTED_REGISTRATION, T_match_query=None, reason='no alignment'
    )
    shift = se3.from_rotation_translation(np.eye(3), [5.0, 0, 0])
    for number in (6, 7):
        T = loops[number].T_match_query
        assert T is not None
        loops[number] = replace(loops[number], T_match_query=T @ shift)
    xyz = np.concatenate(
        [
            truth.positions[:, None, :] + rng.uniform([-15, -15, 0], [15, 15, 6], (SCANS, 60, 3)),
        ]
    ).reshape(-1, 3)
    times = {
        '/lidar_odometry': {'convert': 1.5, 'registration': 35.0},
        '/loop_closure': {'descriptor': 9.0, 'registration': 60.0, 'refinement': 25.0},
        '/pose_graph': {'update': 4.0},
    }
    return DriveResult(
        name='eight',
        source='an eight',
        odometry=odometry,
        keyframes=Trajectory(truth.stamps_ns[index], noisy),
        loops=tuple(loops),
        truth=truth,
        map_cloud=PointCloud(xyz.astype(np.float32)),
        graph=MeasuredGraph(
            np.arange(len(index)),
            noisy,
            np.stack([np.arange(len(index) - 1), np.arange(1, len(index))], axis=1),
            se3.inverse(noisy[:-1]) @ noisy[1:],
            np.tile(np.eye(6) * 1e-4, (len(index) - 1, 1, 1)),
        ),
        stage_times_ms={
            node: {stage: list(rng.lognormal(np.log(ms), 0.3, 300)) for stage, ms in stages.items()}
            for node, stages in times.items()
        },
        counts={'/lidar_odometry': {'rejected: NaN points': 2, 'scans': 800}},
        skipped={'truncated velodyne file': 1},
        scan_stamps_ns=START_NS + PERIOD_NS * np.arange(SCANS + 1),
        recorded_s=79.9,
        wall_s=40.0,
    )


def _loop(truth: Trajectory, match: int, query: int) -> LoopConstraint:
    T_match_query = se3.inverse(truth.T_world_body[match]) @ truth.T_world_body[query]
    return LoopConstraint(
        match_id=match // EVERY,
        query_id=query // EVERY,
        match_stamp_ns=int(truth.stamps_ns[match]),
        query_stamp_ns=int(truth.stamps_ns[query]),
        T_match_query=T_match_query,
        covariance=np.eye(6) * 1e-3,
        descriptor_distance=0.2,
        fitness=0.8,
        rmse_m=0.1,
        inliers=1000,
        overlap=0.7,
        method='scan_context+bev+gicp',
    )
