"""Make messages of a small drive for node tests: a circle of 20 m radius, driven more than once."""

from functools import cache

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.nodes import messages
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.nodes.conversions import keyframe_message, loop_message
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
STEP_M = 1.0
RADIUS_M = 20.0
T_BASE_LIDAR = se3.from_rotation_translation(se3.so3_exp([0, 0, 0.5]), [0.2, 0.0, 1.73])
LINK = np.diag([1e-4, 1e-4, 1e-5, 1e-7, 1e-7, 1e-6])
LOOP = np.diag([1e-3] * 3 + [1e-5] * 3)


def stamp(step: int) -> int:
    """Return the stamp of a step, nanoseconds."""
    return START_NS + step * STEP_NS


def true_pose(step: float) -> np.ndarray:
    """Return T_world_base; the world starts where the drive does."""
    angle = step * STEP_M / RADIUS_M
    return se3.from_rotation_translation(
        se3.so3_exp([0, 0, angle]),
        [RADIUS_M * np.sin(angle), RADIUS_M * (1 - np.cos(angle)), 0.0],
    )


@cache
def odometry_pose(step: int, drift: float = 0.0) -> np.ndarray:
    """Return T_odom_base of an odometry that turns by `drift` radians a step too much."""
    if step == 0:
        return np.eye(4)
    motion = se3.inverse(true_pose(step - 1)) @ true_pose(step)
    return odometry_pose(step - 1, drift) @ motion @ se3.exp([0, 0, 0, 0, 0, drift])


@cache
def _accumulated(step: int) -> np.ndarray:
    if step == 0:
        return 1e-9 * np.eye(6)
    motion = se3.inverse(true_pose(step - 1)) @ true_pose(step)
    return se3.compose_covariance(_accumulated(step - 1), motion, LINK)


def odom_message(step: int, drift: float = 0.0, covariance: bool = True) -> Odometry:
    """Return odometry at a step, its covariance accumulated since the start."""
    T, accumulated = odometry_pose(step, drift), _accumulated(step)
    message = Odometry(header=messages.header(stamp(step), 'odom'), child_frame_id='base_link')
    message.pose = messages.pose_with_covariance(T, accumulated if covariance else None)
    return message


def scan(step: int, count: int = 3000, stamp_ns: int | None = None) -> PointCloud2:
    """Return a cloud in the lidar's frame: posts around the vehicle, others at every step."""
    random = np.random.default_rng(step)
    around = random.uniform(-30, 30, (count // 20, 2))
    heights = np.tile(np.linspace(0.0, 4.0, 20), len(around))
    xyz = np.column_stack([np.repeat(around, 20, axis=0), heights]).astype(np.float32)
    cloud = PointCloud(xyz).transformed(se3.inverse(T_BASE_LIDAR))
    return messages.cloud_message(cloud, stamp(step) if stamp_ns is None else stamp_ns, 'lidar')


def static_transform() -> TFMessage:
    """Return /tf_static with base_link -> lidar."""
    transform = TransformStamped(
        header=messages.header(START_NS, 'base_link'),
        child_frame_id='lidar',
        transform=messages.transform_message(T_BASE_LIDAR),
    )
    return TFMessage(transforms=[transform])


def keyframe(step: int, drift: float = 0.0, first_id: int = 0) -> KeyframeMessage:
    """Return the keyframe that is taken at every step; its id is the step's."""
    motion = np.eye(4)
    if step:
        motion = se3.inverse(true_pose(step - 1)) @ true_pose(step)
        motion = motion @ se3.exp([0, 0, 0, 0, 0, drift])
    random = np.random.default_rng(step)
    made = Keyframe(
        id=first_id + step,
        stamp_ns=stamp(step),
        T_odom_base=odometry_pose(step, drift),
        T_previous_this=motion,
        motion_covariance=LINK if step else None,
        cloud=PointCloud(random.uniform(-20, 20, (200, 3)).astype(np.float32)),
        descriptor=random.uniform(0, 1, 8).astype(np.float32),
        descriptor_method='scan_context',
    )
    return keyframe_message(made, 'odom', 'base_link')


def loop(
    match: int,
    query: int,
    wrong_by_m: float = 0.0,
    status: LoopStatus = LoopStatus.ACCEPTED,
    query_id: int | None = None,
) -> LoopConstraintMessage:
    """Return a loop constraint between two steps, true or wrong by metres sideways."""
    T = se3.inverse(true_pose(match)) @ true_pose(query) @ se3.exp([0, wrong_by_m, 0, 0, 0, 0])
    made = LoopConstraint(
        match_id=match,
        query_id=query if query_id is None else query_id,
        match_stamp_ns=stamp(match),
        query_stamp_ns=stamp(query),
        T_match_query=T,
        covariance=LOOP if status is LoopStatus.ACCEPTED else None,
        fitness=0.9,
        rmse_m=0.1,
        method='made up',
        status=status,
        reason='' if status is LoopStatus.ACCEPTED else 'made up',
    )
    return loop_message(made, 'base_link')
