"""Paint surfaces: what share of the light each point sends back, by what it is made of."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.simulation.appearance import Floats, Kind

_SIZE = 1024  # texels of the noise, each way
_POSITIVE_M = 4096.0  # added to coordinates: truncation is then the floor
_DRY, _MORTAR, _CURTAIN = (
    np.array(colour, np.float32)[:, None]
    for colour in ((0.060, 0.040, 0.022), (0.36, 0.34, 0.31), (0.24, 0.23, 0.21))
)


@dataclass(frozen=True)
class Patch:
    """Points of one kind, as the camera sees them.

    Attributes:
        u, v: [N] metres along the surface.
        footprint_m: [N] what a pixel covers of the surface; finer detail is left out.
        tint: [3 x N] reflectance of the object.
        extent: [4 x N] of the object in u and v, see Appearance.
        pick: [N] a random number of the object.
    """

    u: Floats
    v: Floats
    footprint_m: Floats
    tint: Floats
    extent: Floats
    pick: Floats


class Textures:
    """Noise of one seed and the materials made from it."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 31])
        self._grain = np.clip(_noise(rng, 0.75) * 40.0, -127, 127).astype(np.int8).ravel()
        self._cloud = np.clip(_noise(rng, 1.75) * 40.0, -127, 127).astype(np.int8).ravel()
        self._pool = rng.random(4096).astype(np.float32)
        self._paint: dict[Kind, Callable[[Patch], Floats]] = {
            Kind.ROAD: self._road,
            Kind.PAVING: self._paving,
            Kind.GRASS: self._grass,
            Kind.PLASTER: self._plaster,
            Kind.BRICK: self._brick,
            Kind.ROOF: self._roof,
            Kind.WINDOW: self._window,
            Kind.LEAF: self._leaf,
            Kind.BARK: self._bark,
            Kind.WOOD: self._wood,
        }

    def albedo(self, kind: Kind, patch: Patch) -> Floats:
        """Return the reflectance [3 x N] of points of one kind, linear 0..1."""
        paint = self._paint.get(kind)
        return patch.tint if paint is None else paint(patch)

    def clouds(self, u: Floats, v: Floats) -> Floats:
        """Return smooth noise [N] of standard deviation 1 that repeats after 1 unit."""
        return self._look_up(self._cloud, u * _SIZE, v * _SIZE) * (1.0 / 40.0)

    def _look_up(self, table: NDArray[np.int8], x: Floats, y: Floats) -> Floats:
        column = (x + np.float32(1 << 20)).astype(np.int32)
        row = (y + np.float32(1 << 20)).astype(np.int32)
        row &= _SIZE - 1
        row <<= 10
        column &= _SIZE - 1
        row |= column
        return table.take(row).astype(np.float32)

    def _noise(self, patch: Patch, texel_m: float, stretch: float = 1.0) -> Floats:
        """Return noise of standard deviation 1, less where a pixel covers many texels."""
        scale = np.float32(1.0 / texel_m)
        found = self._look_up(self._grain, patch.u * scale, patch.v * (scale / stretch))
        # Half of this noise's power is in detail of about 6 texels and more.
        return found * (self._fade(patch, 6.0 * texel_m) * np.float32(1.0 / 40.0))

    def _fade(self, patch: Patch, detail_m: float) -> Floats:
        """Return 1 where detail of a size is seen .. 0 where it is averaged within a pixel."""
        return np.minimum(np.float32(detail_m) / patch.footprint_m, np.float32(1.0))

    def _random(self, row: NDArray[np.int32], column: NDArray[np.int32]) -> Floats:
        return self._pool.take((row * 73 + column * 1151) & 4095)

    def _road(self, patch: Patch) -> Floats:
        """Asphalt: grain, worn and mended places."""
        worn = self._noise(patch, 0.11)
        bright = 1.0 + 0.13 * self._noise(patch, 0.012) + 0.07 * worn
        bright -= 0.10 * (worn > 1.6) * self._fade(patch, 0.3)
        return patch.tint * bright

    def _paving(self, patch: Patch) -> Floats:
        """Slabs of half a metre with joints."""
        joint, row, column = self._bond(patch, 0.5, 0.5, 0.012)
        bright = 1.0 - 0.35 * joint
        bright += 0.20 * (self._random(row, column) - 0.5) * self._fade(patch, 0.5)
        bright += 0.07 * self._noise(patch, 0.02)
        return patch.tint * bright

    def _grass(self, patch: Patch) -> Floats:
        """Blades, and drier places."""
        dry = 0.5 + 0.25 * self._noise(patch, 0.13)
        colour = patch.tint + np.clip(dry, 0, 1) * _DRY
        return colour * np.maximum(1.0 + 0.32 * self._noise(patch, 0.012), 0.2)

    def _plaster(self, patch: Patch) -> Floats:
        """Grain, stains and streaks that run down."""
        bright = 1.0 + 0.035 * self._noise(patch, 0.01) + 0.05 * self._noise(patch, 0.07)
        bright += 0.035 * self._noise(patch, 0.02, stretch=18.0)
        return patch.tint * bright

    def _brick(self, patch: Patch) -> Floats:
        """Courses of bricks, each of its own shade, in light mortar."""
        joint, row, column = self._bond(patch, 0.25, 0.075, 0.012)
        shade = 1.0 + 0.5 * (self._random(row, column) - 0.5) * self._fade(patch, 0.16)
        shade += 0.08 * self._noise(patch, 0.015) + 0.07 * self._noise(patch, 0.09)
        share = joint * np.float32(0.7)
        return patch.tint * (shade * (1.0 - share)) + share * _MORTAR

    def _roof(self, patch: Patch) -> Floats:
        """Tiles that shade the row below."""
        joint, row, column = self._bond(patch, 0.22, 0.32, 0.04)
        bright = 1.0 - 0.45 * joint
        bright += 0.35 * (self._random(row, column) - 0.5) * self._fade(patch, 0.25)
        bright += 0.10 * self._noise(patch, 0.09)
        return patch.tint * bright

    def _bond(
        self, patch: Patch, long_m: float, high_m: float, joint_m: float
    ) -> tuple[Floats, NDArray[np.int32], NDArray[np.int32]]:
        """Return how much of a joint each point is (0..1), and row and column of its stone."""
        y = (patch.v + np.float32(_POSITIVE_M)) * np.float32(1.0 / high_m)
        row = y.astype(np.int32)
        x = (patch.u + np.float32(_POSITIVE_M)) * np.float32(1.0 / long_m)
        x += np.float32(0.5) * (row & 1).astype(np.float32)
        column = x.astype(np.int32)
        within = ((y - row) < joint_m / high_m) | ((x - column) < joint_m / long_m)
        share = np.float32(joint_m / high_m + joint_m / long_m)  # where joints blur into the rest
        joint = share + np.square(self._fade(patch, joint_m)) * (within - share)
        return joint.astype(np.float32), row, column

    def _window(self, patch: Patch) -> Floats:
        """Frames around panes, curtains or the dark of a room behind them."""
        left, right = patch.u - patch.extent[0], patch.extent[1] - patch.u
        below, above = patch.v - patch.extent[2], patch.extent[3] - patch.v
        frame = np.minimum(np.minimum(left, right), np.minimum(below, above)) < 0.07
        wide = left + right > 0.7
        frame |= wide & (np.abs(left - right) < 0.06)
        curtain = (patch.pick > 0.55) & (above < (patch.pick - 0.5) * 4.0 * (above + below))
        colour = np.where(curtain, _CURTAIN, patch.tint)
        frames = np.where(patch.pick * 7.0 % 1.0 > 0.3, np.float32(0.55), np.float32(0.13))
        return np.where(frame, frames, colour)

    def _leaf(self, patch: Patch) -> Floats:
        return patch.tint * np.maximum(1.0 + 0.35 * self._noise(patch, 0.015), 0.15)

    def _bark(self, patch: Patch) -> Floats:
        return patch.tint * (1.0 + 0.3 * self._noise(patch, 0.008, stretch=6.0))

    def _wood(self, patch: Patch) -> Floats:
        return patch.tint * (1.0 + 0.2 * self._noise(patch, 0.006, stretch=25.0))


def _noise(rng: np.random.Generator, falling: float) -> NDArray[np.float64]:
    """Return periodic noise [SIZE x SIZE], deviation 1, amplitude falling by frequency^falling."""
    spectrum = np.fft.rfft2(rng.normal(size=(_SIZE, _SIZE)))
    frequency = np.hypot(np.fft.fftfreq(_SIZE)[:, None], np.fft.rfftfreq(_SIZE)) * _SIZE
    frequency[0, 0] = np.inf
    # Waves longer than an eighth of the period would show that it repeats.
    spectrum /= np.maximum(frequency, 8.0 if falling < 1 else 2.0) ** falling
    noise = np.fft.irfft2(spectrum, (_SIZE, _SIZE))
    return np.asarray(noise / noise.std())
