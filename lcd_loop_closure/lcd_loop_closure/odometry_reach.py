"""Tell which keyframes cannot be near by odometry, however much it drifted."""

import numpy as np

from lcd_loop_closure.keyframes import Keyframe

_BROKEN_M, _BROKEN_RAD = 1.0, 0.2  # a link less sure than this may have moved the map anywhere


class OdometryReach:
    """Remember where odometry met each keyframe, and where it may have lost its way."""

    def __init__(self, max_drift: float, margin_m: float) -> None:
        """Start empty.

        Args:
            max_drift: how wrong odometry may be, as a share of the distance driven in between.
            margin_m: a keyframe nearer than this is near in any case.
        """
        self.max_drift, self.margin_m = max_drift, margin_m
        self._met: dict[int, tuple[float, int, np.ndarray]] = {}
        self._breaks = 0

    def arrive(self, keyframe: Keyframe, travelled_m: float) -> None:
        """Take in the newest keyframe, met after `travelled_m` of path."""
        covariance = keyframe.motion_covariance
        if covariance is not None:
            sigma = np.sqrt(np.diag(covariance))
            self._breaks += bool(sigma[:3].max() > _BROKEN_M or sigma[3:].max() > _BROKEN_RAD)
        self._met[keyframe.id] = travelled_m, self._breaks, keyframe.T_odom_base[:3, 3]

    def forget(self, id: int) -> None:
        """Forget one keyframe; an unknown id is no error."""
        self._met.pop(id, None)

    def plausible(self, match_id: int, query_id: int) -> bool:
        """Tell whether two keyframes may be near each other.

        They may when odometry lost its way in between, or when one of them is of another session.
        """
        if match_id not in self._met or query_id not in self._met:
            return True
        travelled_match, breaks_match, p_match = self._met[match_id]
        travelled_query, breaks_query, p_query = self._met[query_id]
        if breaks_match != breaks_query:
            return True
        driven = abs(travelled_query - travelled_match)
        away = float(np.linalg.norm(p_query - p_match))
        return away <= self.margin_m + self.max_drift * driven
