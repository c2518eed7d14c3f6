"""Turn chosen scans into a chain of keyframes."""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.local_features import LocalFeatures


class KeyframeBuilder:
    """Number keyframes and measure the motion between them, with its covariance.

    Odometry's pose covariance accumulates along the path; what it gained since the last keyframe is
    the motion's own. Where it did not accumulate (a constant, zeros) the motion's is unknown.
    """

    def __init__(self, first_id: int = 0) -> None:
        """Start a session; `first_id` continues the numbering of a loaded map."""
        self.next_id = first_id
        self._last: StampedPose | None = None

    def build(
        self,
        pose: StampedPose,
        cloud: PointCloud,
        descriptor: NDArray[np.float32] | None,
        descriptor_method: str,
        features: LocalFeatures | None = None,
    ) -> Keyframe:
        """Make the next keyframe of the chain from odometry at its stamp and its reduced cloud."""
        T_previous_this, covariance = self._motion(pose)
        keyframe = Keyframe(
            id=self.next_id,
            stamp_ns=pose.stamp_ns,
            T_odom_base=pose.T_odom_base,
            T_previous_this=T_previous_this,
            motion_covariance=covariance,
            cloud=cloud,
            descriptor=descriptor,
            descriptor_method=descriptor_method,
            features=features,
        )
        self.next_id += 1
        self._last = pose
        return keyframe

    def _motion(self, pose: StampedPose) -> tuple[se3.Array, se3.Array | None]:
        if self._last is None:
            return np.eye(4), None
        T_previous_this = se3.inverse(self._last.T_odom_base) @ pose.T_odom_base
        if self._last.covariance is None or pose.covariance is None:
            return T_previous_this, None
        return T_previous_this, se3.relative_covariance(
            self._last.covariance, T_previous_this, pose.covariance
        )
