"""Prepare a pinhole camera for projection: which ray belongs to each pixel."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.records import CameraModel
from lcd_common.errors import DataError

Floats = NDArray[np.float32]
_ITERATIONS = 40  # of the inverse of the distortion; strong lenses converge slowly at the edge


@dataclass(frozen=True)
class Lens:
    """A camera in the numbers that projection needs.

    Attributes:
        width, height: of the image, pixels.
        focal: fx, fy in pixels.
        centre: cx, cy in pixels; pixel (0, 0) has its middle at (0, 0).
        distortion: plumb_bob: k1 k2 p1 p2 k3.
        max_radius_squared: of normalised coordinates; farther out the polynomial folds back, and
            what lies there is not seen.
        rays: [H x W x 2] x/z and y/z of the pixels' middles, without distortion.
    """

    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: Floats
    max_radius_squared: float
    rays: Floats


def make_lens(camera: CameraModel) -> Lens:
    """Return the lens of a camera.

    Raises:
        DataError: the calibration is no pinhole's, e.g. a focal length is not positive.
    """
    K = np.asarray(camera.K, np.float64)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError(f'expected a camera matrix with positive focal lengths, got {K.tolist()}')
    if K[0, 1] != 0:
        raise DataError(f'expected a camera without skew, got K[0, 1] = {K[0, 1]:g}')
    if camera.width < 1 or camera.height < 1:
        raise DataError(f'expected an image with pixels, got {camera.width} x {camera.height}')
    distortion = np.zeros(5)
    if len(camera.distortion) > 5 or not np.isfinite(camera.distortion).all():
        raise DataError(
            f'expected the distortion k1 k2 p1 p2 k3 (plumb_bob), got {camera.distortion}; '
            'rectify images of other lenses'
        )
    distortion[: len(camera.distortion)] = camera.distortion
    limit = _fold(distortion)
    x = (np.arange(camera.width) - K[0, 2]) / K[0, 0]
    y = (np.arange(camera.height) - K[1, 2]) / K[1, 1]
    rays = np.stack(np.meshgrid(x, y), axis=-1)
    if distortion.any():
        rays = _undistorted(rays, distortion)
    return Lens(
        camera.width,
        camera.height,
        (float(K[0, 0]), float(K[1, 1])),
        (float(K[0, 2]), float(K[1, 2])),
        distortion.astype(np.float32),
        limit,
        rays.astype(np.float32),
    )


def distorted(xy: NDArray[np.float64], distortion: NDArray[np.floating]) -> NDArray[np.float64]:
    """Apply plumb_bob to normalised coordinates [... x 2]."""
    k1, k2, p1, p2, k3 = distortion
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _undistorted(xy: NDArray[np.float64], distortion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert `distorted` by Newton's method with a numerical derivative."""
    at, step = xy.copy(), 1e-6
    along_x, along_y = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(_ITERATIONS):
        here = distorted(at, distortion)
        error = here - xy
        if np.abs(error).max() < 1e-10:
            break
        dx = (distorted(at + along_x, distortion) - here) / step
        dy = (distorted(at + along_y, distortion) - here) / step
        determinant = dx[..., 0] * dy[..., 1] - dy[..., 0] * dx[..., 1]
        determinant = np.where(np.abs(determinant) < 1e-6, 1e-6, determinant)
        move = np.stack(
            [
                (dy[..., 1] * error[..., 0] - dy[..., 0] * error[..., 1]) / determinant,
                (dx[..., 0] * error[..., 1] - dx[..., 1] * error[..., 0]) / determinant,
            ],
            axis=-1,
        )
        at -= np.clip(move, -0.5, 0.5)
    return at


def _fold(distortion: NDArray[np.float64]) -> float:
    """Return the squared radius from where a longer radius no longer lands farther out."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots[np.abs(roots.imag) < 1e-9].real
    ahead = real[real > 0]
    return float(ahead.min()) if len(ahead) else float('inf')
