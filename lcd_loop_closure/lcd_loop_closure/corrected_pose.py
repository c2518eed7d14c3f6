"""Carry the graph's estimate forward from its newest keyframe by odometry."""

from dataclasses import dataclass

from lcd_common import se3
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.graph_noise import GraphNoise


@dataclass(frozen=True)
class CorrectedPose:
    """The newest keyframe: how the graph sees it, and how odometry saw it.

    Attributes:
        T_map_odom: the graph's correction of odometry.
        covariance: 6x6 of the keyframe's T_map_base, body axes; None when unknown.
        keyframe: odometry at the keyframe; its covariance is the one accumulated until then.
    """

    T_map_odom: se3.Array
    covariance: se3.Array | None
    keyframe: StampedPose

    def at(self, odometry: StampedPose, noise: GraphNoise) -> tuple[se3.Array, se3.Array | None]:
        """Return T_map_base now and its 6x6: the keyframe's, and odometry's since then."""
        T_map_base = self.T_map_odom @ odometry.T_odom_base
        if self.covariance is None:
            return T_map_base, None
        T_keyframe_base = se3.inverse(self.keyframe.T_odom_base) @ odometry.T_odom_base
        since = None
        if self.keyframe.covariance is not None and odometry.covariance is not None:
            since = se3.relative_covariance(
                self.keyframe.covariance, T_keyframe_base, odometry.covariance
            )
        motion = noise.odometry(T_keyframe_base, since)
        return T_map_base, se3.compose_covariance(self.covariance, T_keyframe_base, motion)
