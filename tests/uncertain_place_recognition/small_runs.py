"""Small runs: submaps of clusters of points whose arrangement tells the place."""

import numpy as np

from lcd_common import se3
from uncertain_place_recognition.runs import SubmapRun


def small_run(
    name: str = 'a',
    world: str = 'w',
    *,
    count: int = 12,
    points: int = 64,
    spacing_m: float = 4.0,
    seed: int = 0,
    noise: float = 0.003,
) -> SubmapRun:
    """Return a straight run; submaps of a place are alike in every run of a world."""
    rng = np.random.default_rng([seed, *name.encode()])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = spacing_m * np.arange(count)
    submaps = []
    for k in range(count):
        place = np.random.default_rng([*world.encode(), k // 2])
        centres = place.uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 0.2], (8, 3))
        submaps.append(np.repeat(centres, points // 8, axis=0) + rng.normal(0, noise, (points, 3)))
    stamps = 1_700_000_000_000_000_000 + 1_000_000_000 * np.arange(count)
    return SubmapRun(name, world, stamps, poses, np.array(submaps, np.float16))


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    """Return points turned about z."""
    R = se3.rotation_z(np.radians(degrees))[:3, :3].astype(np.float32)
    return np.asarray(points, np.float32) @ R.T
