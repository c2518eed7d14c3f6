"""Colour the sky by direction."""

import numpy as np

from bags.simulation.appearance import Floats
from bags.simulation.scene import Light
from bags.simulation.textures import Textures


def _rgb(red: float, green: float, blue: float) -> Floats:
    return np.array([[red], [green], [blue]], np.float32)


HAZE = _rgb(0.80, 0.86, 0.93)
_ZENITH, _HORIZON = _rgb(0.30, 0.50, 0.92), _rgb(0.86, 0.93, 1.0)
_CLOUD, _GROUND = _rgb(1.12, 1.12, 1.10), _rgb(0.13, 0.13, 0.12)


class Sky:
    """A gradient from horizon to zenith, clouds, a glow around the sun."""

    def __init__(self, light: Light, textures: Textures) -> None:
        self._textures = textures
        self._to_sun = (light.to_sun / np.linalg.norm(light.to_sun)).astype(np.float32)
        self._sun = np.float32(light.sun)
        # Clouds: a third of the sky in full sun, all of it without any.
        self._cover = np.float32(-0.4 + 2.4 * (1.0 - light.sun))

    def colour(self, directions: Floats) -> Floats:
        """Return the light [3 x N] from world directions [3 x N]; below the horizon, the ground."""
        up = np.maximum(directions[2], np.float32(0.0))
        colour = _HORIZON + np.sqrt(up) * (_ZENITH - _HORIZON)
        far = np.float32(0.16) / (up + np.float32(0.09))
        u, v = directions[0] * far, directions[1] * far
        fine = self._textures.clouds(v * np.float32(3.1), u * np.float32(3.1))
        dense = self._textures.clouds(u, v) + np.float32(0.5) * fine
        dense = np.clip((dense + self._cover) * np.float32(0.8), 0.0, 1.0)
        colour += dense * (_CLOUD * (np.float32(1.0) - np.float32(0.18) * dense) - colour)
        glow = np.maximum(self._to_sun @ directions, np.float32(0.0))
        for _ in range(5):  # to the power of 32
            glow *= glow
        colour += np.float32(0.5) * self._sun * glow
        below = np.clip(directions[2] * np.float32(-8.0), 0.0, 1.0)
        colour += below * (_GROUND - colour)
        return colour
