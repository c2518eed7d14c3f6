"""Tell what a motion that changes within a sweep does to the sweep's pose."""

import numpy as np

from lcd_common import se3
from lcd_common.se3 import Array

_MEMORY = 0.9  # of what was usual, per sweep


class UnsteadyMotion:
    """Follow the motion per step, its change and the change of that.

    Motions are twists [6] per step, in metres and radians: between the middles of two sweeps.
    """

    def __init__(self) -> None:
        """Start at rest."""
        self._change = np.zeros(6)
        self._usual = np.zeros((6, 6))
        self._covariance = np.zeros((6, 6))  # of the last pose
        self.steady = False  # whether the last two motions tell an acceleration

    def to_stamp(self, share: float, motion: Array, change: Array) -> Array:
        """Return the transform from the middle of a sweep to its stamp.

        Args:
            share: of a step that the stamp lies before the middle; 1 is the last middle.
            motion: of the step that ends in this middle.
            change: of the motion since the step before; counts only while steady.
        """
        twist = -share * motion
        if self.steady:
            twist = twist - 0.5 * share * (1.0 - share) * change
        return se3.exp(twist)

    def at_middle(self, motion: Array, change: Array) -> Array:
        """Return the motion in the middle of a sweep; that of the step lags half a step behind."""
        return motion + 0.5 * change if self.steady else motion

    def covariance(self, change: Array, share: float) -> Array:
        """Return the covariance, 6x6, that a motion has by it; call once per sweep.

        With `a` the change of the motion between two steps and `j` the change of that: points tell
        the pose on average over the sweep's time, which an acceleration moves by a/24; it was
        undone with a twist that was off by j/3, so by j/10 root mean square over the sweep; and
        the way to the stamp, a share s of a step, is a polynomial through the last poses, whose
        remainder is s(1-s)(2-s)/6 j for constant acceleration and s(1-s)/2 a for constant speed.
        """
        jerk = change - self._change
        remainder = 0.5 * share * (1.0 - share)
        to_stamp = (2.0 - share) / 3.0 * remainder * jerk if self.steady else remainder * change
        parts = np.stack([change / 24.0, jerk / 10.0, to_stamp])
        now = parts.T @ parts
        self._usual = _MEMORY * self._usual + (1.0 - _MEMORY) * now
        before, self._covariance = self._covariance, 0.5 * (self._usual + now)
        return before + self._covariance

    def lose(self, covariance: Array, share: float) -> None:
        """Note that a motion is known no better than `covariance`, and so the way to the stamp."""
        self._covariance = covariance * share**2

    def take(self, change: Array, *, steady: bool) -> None:
        """Remember the change of a motion; `steady` says whether the next change counts."""
        self._change, self.steady = change, steady
