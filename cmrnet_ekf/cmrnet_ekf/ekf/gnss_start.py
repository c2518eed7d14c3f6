"""Find a start pose from satellite fixes: where the vehicle is, and its heading from its course."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from lcd_common import se3
from lcd_common.settings import config, setting

# How far the nose may point off the way between two fixes: bends, slip.
_COURSE_SIGMA_RAD = 0.15
_TILT_SIGMA_RAD = 0.1


@config
class GnssStartConfig:
    """When satellite fixes suffice to start."""

    baseline: float = setting(
        5.0, 'way between two fixes that gives the heading (driving forward)', unit='m', low=0.5
    )
    window: float = setting(5.0, 'longest time between the two fixes', unit='s', low=0.1)


@dataclass(frozen=True)
class StartPose:
    """Where a filter can start; the covariance is 6x6 in body axes, the velocity in map axes."""

    stamp_ns: int
    T_map_base: se3.Array
    covariance: se3.Array
    velocity_map: se3.Array
    velocity_sigma: float


@dataclass(frozen=True)
class _Fix:
    stamp_ns: int
    position_map: se3.Array
    sigma: float


class GnssStart:
    """Collect fixes until two of them are far enough apart for a course."""

    def __init__(self, settings: GnssStartConfig) -> None:
        self.settings = settings
        self._fixes: deque[_Fix] = deque(maxlen=100)

    def clear(self) -> None:
        """Forget the fixes (after a clock jump, a reset)."""
        self._fixes.clear()

    def add(
        self, stamp_ns: int, position_map: se3.Array, covariance: se3.Array, lever: se3.Array
    ) -> StartPose | None:
        """Take a fix of a point given in the base frame; return the start, if there is one now.

        Args:
            stamp_ns: of the fix.
            position_map: [3].
            covariance: 3x3 in map axes.
            lever: [3] of the antenna in the base frame.
        """
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        new = _Fix(stamp_ns, position_map, sigma)
        begin_ns = stamp_ns - round(self.settings.window * 1e9)
        while self._fixes and self._fixes[0].stamp_ns < begin_ns:
            self._fixes.popleft()
        # The latest that is far enough away: the course then is the freshest.
        for old in reversed(self._fixes):
            way = new.position_map - old.position_map
            length = float(np.hypot(way[0], way[1]))
            error = float(np.hypot(new.sigma, old.sigma))
            if old.stamp_ns < stamp_ns and length >= max(self.settings.baseline, 4.0 * error):
                return _start(old, new, covariance, lever)
        self._fixes.append(new)
        return None


def _start(old: _Fix, new: _Fix, covariance: se3.Array, lever: se3.Array) -> StartPose:
    way = new.position_map - old.position_map
    length, error = float(np.hypot(way[0], way[1])), float(np.hypot(new.sigma, old.sigma))
    seconds = (new.stamp_ns - old.stamp_ns) * 1e-9
    T = se3.rotation_z(float(np.arctan2(way[1], way[0])))
    T[:3, 3] = new.position_map - T[:3, :3] @ lever
    P = np.zeros((6, 6))
    P[:3, :3] = T[:3, :3].T @ covariance @ T[:3, :3]
    yaw_sigma = float(np.hypot(_COURSE_SIGMA_RAD, error / length))
    P[3:, 3:] = np.diag([_TILT_SIGMA_RAD**2, _TILT_SIGMA_RAD**2, yaw_sigma**2])
    # The mean over the time between; the vehicle may have changed its speed since.
    return StartPose(new.stamp_ns, T, P, way / seconds, error / seconds + 1.0)
