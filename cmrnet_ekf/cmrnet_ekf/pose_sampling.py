"""Draw rough initial poses as CMRNet's authors do, one range for each stage of refinement."""

from dataclasses import dataclass

import numpy as np

from cmrnet_ekf import euler
from lcd_common import se3

# From the optical frame (z forward, x right) to the same camera with the vehicle's axes: x forward,
# y left, z up. Errors and uncertainties are told about these.
T_BODY_OPTICAL: se3.Array = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
T_OPTICAL_BODY: se3.Array = se3.inverse(T_BODY_OPTICAL)


@dataclass(frozen=True)
class NoiseRange:
    """How far a guess may be off: uniformly within +-translation_m and +-rotation_rad an axis.

    Below the true height a guess is off by at most 1 m: a camera sits that high above the road.
    """

    translation_m: float
    rotation_rad: float

    def draw(self, rng: np.random.Generator, count: int) -> se3.Array:
        """Return T_camera_guess [N x 4 x 4], axes forward, left, up."""
        t, r = self.translation_m, self.rotation_rad
        low, high = np.array([-t, -t, -min(t, 1.0)]), np.array([t, t, t])
        xyz = rng.uniform(low, high, (count, 3))
        return euler.transforms(np.concatenate([xyz, rng.uniform(-r, r, (count, 3))], 1))


# Of the three networks that refine one after the other.
STAGES = tuple(
    NoiseRange(metres, float(np.deg2rad(degrees)))
    for metres, degrees in ((2.0, 10.0), (1.0, 2.0), (0.6, 2.0))
)


def targets(T_camera_guess: se3.Array) -> se3.Array:
    """Return what the network shall say of guesses: components [N x 6] of T_guess_camera."""
    return euler.components(se3.inverse(T_camera_guess))
