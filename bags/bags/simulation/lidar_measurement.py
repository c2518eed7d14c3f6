"""Turn what rays hit into what a LiDAR returns: echoes, edges, losses, noise.

Every ray is measured by the same formulas on arrays of any leading shape [... x C x B], by numpy or
by torch (`xp`), so that both renderers err alike. The physics is that of the LiDAR equation: the
echo is reflectivity times a rough surface's cosine over the squared range.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bags.simulation.lidar_model import LidarModel

# A rough surface (asphalt above all) sends more back at grazing angles than Lambert's cosine.
_ROUGHNESS = 0.6
# Echoes nearer to each other than about half a pulse melt into one range between them.
_PULSE_M = 1.0
_EDGE_M = 0.25
_INTENSITY_SIGMA, _INTENSITY_STEP = 0.02, 0.01
_NOWHERE_M = 1e6


@dataclass(frozen=True)
class Surfaces:
    """What each ray meets, all [... x C x B]: range (infinity: nothing), cosine, and material.

    `reflectivity` is the share of the light sent back, `return_share` that of rays which come back
    at all at normal incidence (glass is mostly looked through).
    """

    range_m: Any
    incidence: Any
    reflectivity: Any
    return_share: Any


@dataclass(frozen=True)
class Draws:
    """Random numbers of a sweep, all [... x C x B]: two normal, two uniform in 0..1.

    Beams that give two echoes need numbers for the weaker one, too; `overlap` is of both.
    """

    range: Any
    intensity: Any
    overlap: Any
    lost: Any
    weaker: 'Draws | None' = None


@dataclass(frozen=True)
class Echoes:
    """What the LiDAR returns, all [... x C x B].

    Attributes:
        range_m: measured; infinity where nothing came back.
        intensity: 0..1, corrected for the range.
        of_neighbour: whether the surface is the neighbouring ray's.
        weaker: the other surface's echo where a beam touches two, of a LiDAR that gives both.
    """

    range_m: Any
    intensity: Any
    of_neighbour: Any
    weaker: 'Echoes | None' = None


@dataclass(frozen=True)
class Neighbours:
    """Whose surface a beam's rim touches: flat index [C x B] and the angle to it, radians."""

    index: NDArray[np.intp]
    spacing_rad: NDArray[np.float32]


def draw(rng: np.random.Generator, shape: tuple[int, ...], dual: bool = False) -> Draws:
    """Draw the random numbers of a sweep, for two echoes a ray if it is `dual`."""
    normal = rng.standard_normal((2, *shape), np.float32)
    uniform = rng.random((2, *shape), np.float32)
    weaker = draw(rng, shape) if dual else None
    return Draws(normal[0], normal[1], uniform[0], uniform[1], weaker)


def neighbours(model: LidarModel, uniform: NDArray[np.floating]) -> Neighbours:
    """Choose, for each ray, the neighbour that an edge within its beam would belong to.

    An edge between two rays lies anywhere between them with equal chance, so it is within the beam
    of one of them with the probability (divergence / 2) / spacing. Rays without one get themselves.

    Args:
        model: of the LiDAR.
        uniform: [C x B] random numbers in 0..1.
    """
    columns, beams = model.columns, len(model.elevation_rad)
    index = np.arange(columns * beams).reshape(columns, beams)
    aside = 2.0 * np.pi / columns * np.cos(model.elevation_rad)
    step = np.abs(np.diff(model.elevation_rad))
    chosen, spacing = index.copy(), np.zeros((columns, beams), np.float32)
    begin = np.zeros(beams)
    candidates = [
        (np.roll(index, 1, axis=0), aside),
        (np.roll(index, -1, axis=0), aside),
        (np.roll(index, 1, axis=1), np.r_[np.inf, step]),
        (np.roll(index, -1, axis=1), np.r_[step, np.inf]),
    ]
    for other, angle in candidates:
        end = begin + np.minimum(0.25, 0.5 * model.divergence_rad / angle)
        within = (uniform >= begin) & (uniform < end)
        chosen = np.where(within, other, chosen)
        spacing = np.where(within, angle, spacing).astype(np.float32)
        begin = end
    return Neighbours(chosen, spacing)


def beam_errors(model: LidarModel, seed: int) -> NDArray[np.float32]:
    """Return the constant range error [B] of each beam of one sensor, metres."""
    rng = np.random.default_rng([seed, 61])
    return rng.normal(0.0, model.beam_sigma_m, len(model.elevation_rad)).astype(np.float32)


def calibrated_directions(model: LidarModel, seed: int) -> NDArray[np.float32]:
    """Return where the calibration of one sensor says its beams point [C x B x 3], lidar frame.

    They really point along the directions of the model; points are computed with these, and no
    calibration is perfect.
    """
    rng = np.random.default_rng([seed, 62])
    up, left = rng.normal(0.0, model.angle_sigma_rad, (2, len(model.elevation_rad)))
    elevation = model.elevation_rad - up - model.elevation_bias_rad
    azimuth = model.azimuth_rad()[:, None] - left
    level = np.cos(elevation)
    z = np.broadcast_to(np.sin(elevation), azimuth.shape)
    return np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, z], axis=-1).astype(
        np.float32
    )


def measure(
    surfaces: Surfaces,
    near: Neighbours | Any,
    draws: Draws,
    model: LidarModel,
    beam_error_m: Any,
    xp: Any = np,
) -> Echoes:
    """Measure a sweep.

    Args:
        surfaces: what the rays meet.
        near: the neighbour of each ray; `index` counts over all rays, leading dimensions included.
        draws: the random numbers.
        model: of the LiDAR.
        beam_error_m: [B] from `beam_errors`.
        xp: numpy or torch, whichever the arrays are of.
    """
    hit = xp.isfinite(surfaces.range_m) & (surfaces.range_m > 0)
    far = xp.zeros_like(surfaces.range_m) + _NOWHERE_M
    own_m = xp.where(hit, surfaces.range_m, far)
    rough = _ROUGHNESS + (1.0 - _ROUGHNESS) * surfaces.incidence
    echo = xp.where(hit, surfaces.reflectivity * rough, 0.0 * far)
    # Loss by looking through or mirroring away grows with the slant.
    slant = 1.0 / xp.clip(surfaces.incidence, 0.3, 1.0)
    comes_back = surfaces.return_share**slant
    tangent = xp.sqrt(1.0 - xp.clip(surfaces.incidence, 0.02, 1.0) ** 2)
    tangent = tangent / xp.clip(surfaces.incidence, 0.02, 1.0)

    def neighbour(values: Any) -> Any:
        return values.reshape(-1)[near.index]

    other_m, other_echo = neighbour(own_m), neighbour(echo)
    gap = xp.abs(other_m - own_m)
    steep = xp.minimum(tangent * own_m, neighbour(tangent * own_m))
    is_edge = (gap > _EDGE_M + 1.5 * near.spacing_rad * steep) & (near.spacing_rad > 0)
    overlap = xp.where(is_edge, 0.5 * draws.overlap, 0.0 * far)
    own_signal = (1.0 - overlap) * echo / own_m**2
    other_signal = overlap * other_echo / other_m**2
    mixed = is_edge & (gap < _PULSE_M)
    of_neighbour = other_signal > own_signal
    total = xp.clip(own_signal + other_signal, 1e-20, None)
    between = (own_signal * own_m + other_signal * other_m) / total
    half = 0.1 / model.reach_m**2

    def detected(true_m: Any, signal: Any, returns: Any, by: Draws) -> tuple[Any, Any]:
        """Return the measured range, infinity where the echo is lost, and the intensity."""
        share = signal**2 / (signal**2 + half**2) * returns
        kept = (by.lost < share * (1.0 - model.dropout)) & (true_m < 0.5 * _NOWHERE_M)
        measured_m = true_m + model.range_sigma_m * by.range + beam_error_m
        if model.range_step_m:
            measured_m = xp.round(measured_m / model.range_step_m) * model.range_step_m
        kept = kept & (measured_m >= model.min_range_m) & (measured_m <= model.max_range_m)
        bright = signal * true_m**2 + _INTENSITY_SIGMA * by.intensity
        bright = xp.round(xp.clip(bright, 0.0, 0.99) / _INTENSITY_STEP) * _INTENSITY_STEP
        return xp.where(kept, measured_m, xp.inf + 0.0 * far), bright

    true_m = xp.where(mixed, between, xp.where(of_neighbour, other_m, own_m))
    signal = xp.where(mixed, total, xp.where(of_neighbour, other_signal, own_signal))
    other_comes_back = neighbour(comes_back)
    returns = xp.where(of_neighbour, other_comes_back, comes_back)
    strongest = detected(true_m, signal, returns, draws)
    weaker = None
    if draws.weaker is not None:
        true_m = xp.where(of_neighbour, own_m, other_m)
        signal = xp.where(of_neighbour, own_signal, other_signal)
        signal = xp.where(is_edge & ~mixed, signal, 0.0 * far)
        returns = xp.where(of_neighbour, comes_back, other_comes_back)
        weaker = Echoes(*detected(true_m, signal, returns, draws.weaker), ~of_neighbour)
    return Echoes(*strongest, of_neighbour, weaker)
