"""Convert keyframes and loop constraints to messages and back."""

import math

import numpy as np

from lcd_common.nodes import messages
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage


def keyframe_message(keyframe: Keyframe, odom_frame: str, base_frame: str) -> KeyframeMessage:
    """Make the message of a keyframe."""
    descriptor = np.empty(0, np.float32) if keyframe.descriptor is None else keyframe.descriptor
    return KeyframeMessage(
        header=messages.header(keyframe.stamp_ns, odom_frame),
        child_frame_id=base_frame,
        id=keyframe.id,
        pose=messages.pose_message(keyframe.T_odom_base),
        motion=messages.pose_with_covariance(keyframe.T_previous_this, keyframe.motion_covariance),
        cloud=messages.cloud_message(keyframe.cloud, keyframe.stamp_ns, base_frame),
        descriptor_method=keyframe.descriptor_method,
        descriptor=descriptor.astype(np.float32).ravel().tolist(),
    )


def keyframe_from_message(message: KeyframeMessage) -> Keyframe:
    """Read a keyframe; raises DataError when its poses, covariance or cloud are broken."""
    T_previous_this, covariance = messages.from_pose_with_covariance(message.motion)
    return Keyframe(
        id=int(message.id),
        stamp_ns=messages.stamp_ns(message.header.stamp),
        T_odom_base=messages.transform_from_pose(message.pose),
        T_previous_this=T_previous_this,
        motion_covariance=covariance,
        cloud=messages.cloud_from_message(message.cloud),
        descriptor=np.asarray(message.descriptor, np.float32) if message.descriptor else None,
        descriptor_method=message.descriptor_method,
    )


def loop_message(loop: LoopConstraint, base_frame: str) -> LoopConstraintMessage:
    """Make the message of a loop constraint; what is None becomes NaN or zeros, as documented."""
    T = np.eye(4) if loop.T_match_query is None else loop.T_match_query
    return LoopConstraintMessage(
        header=messages.header(loop.query_stamp_ns, base_frame),
        match_id=loop.match_id,
        query_id=loop.query_id,
        match_stamp=messages.time_message(loop.match_stamp_ns),
        query_stamp=messages.time_message(loop.query_stamp_ns),
        transform=messages.pose_with_covariance(T, loop.covariance),
        descriptor_distance=_or_nan(loop.descriptor_distance),
        fitness=_or_nan(loop.fitness),
        rmse=_or_nan(loop.rmse_m),
        inliers=loop.inliers,
        overlap=_or_nan(loop.overlap),
        false_match_probability=_or_nan(loop.false_match_probability),
        method=loop.method,
        status=int(loop.status),
        reason=loop.reason,
    )


def loop_from_message(message: LoopConstraintMessage) -> LoopConstraint:
    """Read a loop constraint; raises DataError when its transform or covariance is broken."""
    T, covariance = messages.from_pose_with_covariance(message.transform)
    registered = not math.isnan(message.fitness)
    return LoopConstraint(
        match_id=int(message.match_id),
        query_id=int(message.query_id),
        match_stamp_ns=messages.stamp_ns(message.match_stamp),
        query_stamp_ns=messages.stamp_ns(message.query_stamp),
        T_match_query=T if registered or covariance is not None else None,
        covariance=covariance,
        descriptor_distance=_or_none(message.descriptor_distance),
        fitness=_or_none(message.fitness),
        rmse_m=_or_none(message.rmse),
        inliers=int(message.inliers),
        overlap=_or_none(message.overlap),
        false_match_probability=_or_none(message.false_match_probability),
        method=message.method,
        status=LoopStatus(message.status),
        reason=message.reason,
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
