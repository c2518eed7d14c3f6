"""Notice an inertial sensor that is frozen, or whose gaps were filled with straight lines."""

import numpy as np

from lcd_common import se3

_LINE = 1e-6  # m/s^2 and rad/s: real samples never lie on a line so closely


class FrozenImu:
    """Tell whether samples are measurements: those of a real sensor have noise.

    Samples that repeat each other, or lie on a straight line in all six channels, are a driver's
    last value or an interpolation. (A simulated sensor without noise looks the same.)

    Args:
        after: so many in a row; 0: never frozen.
    """

    def __init__(self, after: int) -> None:
        self.after = after
        self._last: se3.Array | None = None
        self._step: se3.Array | None = None
        self._on_line = 0

    def check(self, turn_rate: se3.Array, force: se3.Array) -> bool:
        """Take a sample, in order; return whether the sensor is frozen."""
        if not self.after:
            return False
        sample = np.concatenate((turn_rate, force))
        if self._last is not None:
            step = sample - self._last
            if self._step is not None:
                straight = abs(step - self._step).max() < _LINE
                self._on_line = self._on_line + 1 if straight else 0
            self._step = step
        self._last = sample
        return self._on_line >= self.after

    def clear(self) -> None:
        """Forget the samples."""
        self._last = self._step = None
        self._on_line = 0
