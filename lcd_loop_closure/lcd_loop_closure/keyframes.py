"""Choose which scans are remembered."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.local_features import LocalFeatures


@dataclass(frozen=True)
class Keyframe:
    """A remembered scan. The pose graph owns its corrected pose; this is what odometry knew.

    Attributes:
        id: counts 0, 1, 2, ... within a session.
        stamp_ns: stamp of the scan.
        T_odom_base: pose by odometry at that time.
        T_previous_this: motion since the previous keyframe (identity for id 0).
        motion_covariance: 6x6 of T_previous_this, body axes, translation first; None when unknown.
        cloud: reduced cloud in the base frame.
        descriptor: flattened float32, or None.
        descriptor_method: name of the descriptor; empty when there is none.
        features: keypoints that register it; None where the descriptor has none, or they are not
            at hand (they do not travel in messages and maps).
    """

    id: int
    stamp_ns: int
    T_odom_base: se3.Array
    T_previous_this: se3.Array
    motion_covariance: se3.Array | None
    cloud: PointCloud
    descriptor: NDArray[np.float32] | None = None
    descriptor_method: str = ''
    features: LocalFeatures | None = None


@config
class KeyframeConfig:
    """When a scan becomes a keyframe."""

    distance: float = setting(3.0, 'travelled distance between keyframes', unit='m', low=0.1)
    angle: float = setting(0.5, 'turned angle between keyframes', unit='rad', low=0.01, high=3.15)


class KeyframeSelector:
    """Decide from odometry alone: far enough or turned enough since the last keyframe."""

    def __init__(self, settings: KeyframeConfig) -> None:
        self.settings = settings
        self._T_odom_last: se3.Array | None = None

    def due(self, T_odom_base: se3.Array) -> bool:
        """Tell whether a scan at this pose should become a keyframe; the first one does."""
        if self._T_odom_last is None:
            return True
        metres, radians = se3.distance(self._T_odom_last, T_odom_base)
        return metres >= self.settings.distance or radians >= self.settings.angle

    def take(self, T_odom_base: se3.Array) -> None:
        """Remember the pose as the last keyframe's."""
        self._T_odom_last = T_odom_base

    def reset(self) -> None:
        """Forget the last keyframe; the next scan becomes one."""
        self._T_odom_last = None
