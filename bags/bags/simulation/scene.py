"""What there is to see in a town at one time: fixed things, moving things and the light."""

from dataclasses import dataclass, field

import numpy as np

from bags.street.mesh import Mesh
from lcd_common import se3


@dataclass(frozen=True)
class Mover:
    """Something that moves on its own: a car, a pedestrian.

    Attributes:
        mesh: in its own frame, x forward, z up, the origin on the ground.
        time_s: [K] increasing, seconds since the drive's start.
        T_world_mover: [K x 4 x 4] at these times; it is not there before the first or after the
            last.
    """

    mesh: Mesh
    time_s: se3.Array
    T_world_mover: se3.Array

    def at(self, time_s: float) -> se3.Array | None:
        """Return T_world_mover at a time, or None when it is not there."""
        if not self.time_s[0] <= time_s <= self.time_s[-1]:
            return None
        after = max(1, int(np.searchsorted(self.time_s, time_s)))
        begin, end = self.time_s[after - 1], self.time_s[after]
        share = float((time_s - begin) / (end - begin))
        return se3.interpolate(self.T_world_mover[after - 1], self.T_world_mover[after], share)


@dataclass(frozen=True)
class Light:
    """Daylight.

    Attributes:
        to_sun: [3] unit vector towards the sun, world frame.
        sun: strength of the direct light, 0 under an overcast sky .. 1.
        ambient: strength of the light from everywhere, 0..1.
        exposure: factor on the brightness of the whole image.
    """

    to_sun: se3.Array = field(default_factory=lambda: np.array([0.48, -0.36, 0.8]))
    sun: float = 0.8
    ambient: float = 0.35
    exposure: float = 1.0


@dataclass(frozen=True)
class Scene:
    """A town during one run.

    Attributes:
        mesh: what stands still, world frame (z up).
        movers: what moves.
        light: of the camera's images.
        seed: of procedural textures, so that a wall looks the same in every run.
    """

    mesh: Mesh
    movers: tuple[Mover, ...] = ()
    light: Light = field(default_factory=Light)
    seed: int = 0
