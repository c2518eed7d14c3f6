"""Small scenes for tests of LiDAR images."""

import numpy as np

from bags.records import CameraModel

# Takes points from x forward, y left, z up to the optical frame.
T_OPTICAL_BODY = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def camera(width: int = 96, height: int = 48, focal: float = 60.0, distortion=(0.0,) * 5):
    K = np.array([[focal, 0, width / 2 - 3.3], [0, focal * 1.1, height / 2 + 1.7], [0, 0, 1]])
    return CameraModel('camera', width, height, K, distortion)


def wall(distance: float, step: float = 0.1, half: float = 8.0) -> np.ndarray:
    """A wall across the view, x forward, from 3 m below to 3 m above."""
    y, z = np.meshgrid(np.arange(-half, half, step), np.arange(-3.0, 3.0, step))
    return np.stack([np.full(y.size, distance), y.ravel(), z.ravel()], axis=1)


def ground(height: float = -1.65, step: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(1.0, 60.0, step), np.arange(-12.0, 12.0, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def street(rng: np.random.Generator) -> np.ndarray:
    points = np.concatenate([ground(), wall(12.0, half=2.0), wall(30.0)])
    return (points + rng.normal(0, 0.02, points.shape)).astype(np.float32)
