"""How long LiDAR images and CMRNet's steps take; the weights do not matter."""

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bags.simulation.car import CAMERA, camera_model
from benchmarks.place_speed import median_ms
from cmrnet_ekf.camera_localizer import CameraLocalizer
from cmrnet_ekf.lidar_image.imager import LidarImager
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import COMPACT, FULL, CmrnetConfig
from cmrnet_ekf.predictors import Predictor
from lcd_common import se3

POINTS = 700_000
FILL = 0.25
_SAMPLES = 30
_STEP = 0.08  # between points of a surface, metres: as a map of voxels of 0.1 m has them
T_BASE_CAMERA = CAMERA.T_parent_child


def evaluate(work: Path, quick: bool = False) -> dict[str, Any]:
    """Measure all of this on one street of 700,000 points, by the threads torch has."""
    del work
    repeats = 3 if quick else 15
    points = street()
    camera = camera_model()
    view = LidarImager(camera)
    T_camera_points = se3.inverse(T_BASE_CAMERA)
    bare = LidarImager(camera, LidarImageConfig(radius=0)).image(points, T_camera_points)
    figures: dict[str, Any] = {
        'speed_conditions': {
            'points': len(points),
            'fill': float((bare > 0).float().mean()),
            'fill_after_occlusion': float((view.image(points, T_camera_points) > 0).float().mean()),
            'image': f'{camera.width} x {camera.height}',
            'threads': torch.get_num_threads(),
            'cores': os.cpu_count(),
            'weights': 'untrained',
        },
        'lidar_image_ms': median_ms(lambda: view.image(points, T_camera_points), repeats),
        # Of one thread: the wall clock also counts what else the machine does.
        'lidar_image_processor_ms': processor_ms(
            lambda: view.image(points, T_camera_points), repeats
        ),
        'step_hz': {
            'compact_cpu': 1e3 / step_ms(COMPACT, points, 'cpu', repeats),
            'full_gpu': None,
        },
        **dropout_cost(repeats),
        'peak_memory_mb': {'compact_step': peak_memory_mb()},
    }
    if not quick:
        figures['step_hz']['full_cpu'] = 1e3 / step_ms(FULL, points, 'cpu', 3)
    if torch.cuda.is_available():
        figures['step_hz']['full_gpu'] = 1e3 / step_ms(FULL, points, 'cuda', repeats)
        figures['gpu'] = torch.cuda.get_device_name()
    return figures


def step_ms(
    settings: CmrnetConfig, points: NDArray[np.float32], device: str, repeats: int
) -> float:
    """Return the median time of a step: framing, LiDAR image, network with evidence, covariance."""
    camera = camera_model()
    network = Cmrnet(replace(settings, head='evidential')).to(device)
    localizer = CameraLocalizer(camera, T_BASE_CAMERA, [Predictor([network])])
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
    there = torch.from_numpy(points).to(device) if device != 'cpu' else points
    return median_ms(lambda: localizer.locate(pixels, there, np.eye(4)), repeats)


def dropout_cost(repeats: int) -> dict[str, float]:
    """Return the time of a pass of the compact network, and of MC dropout in terms of it."""
    image = torch.zeros(1, 3, COMPACT.height, COMPACT.width)
    lidar = torch.zeros(1, COMPACT.height, COMPACT.width)
    network = Cmrnet(replace(COMPACT, dropout=0.3))
    once, often = Predictor([network], samples=1), Predictor([network], samples=_SAMPLES)
    # In turns: what else the machine does meets both.
    times = [
        [median_ms(partial(one.belief, image, lidar), 1) for one in (once, often)]
        for _ in range(3 * repeats)
    ]
    one_ms, many_ms = np.median(times, axis=0)
    return {'compact_pass_ms': float(one_ms), 'mcd_cost_ratio': float(many_ms / one_ms)}


def processor_ms(call: Callable[[], Any], repeats: int) -> float:
    """Return the median processor time of a call after one that does not count."""
    times = []
    for _ in range(repeats + 1):
        begin = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - begin))
    return statistics.median(times[1:])


def peak_memory_mb() -> float:
    """Return the peak resident memory of a process that makes compact steps on the street."""
    code = 'from benchmarks.cmrnet_speed import _steps; _steps()'
    out = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    ).stdout
    return float(out.split()[-1])


def _steps() -> None:
    step_ms(COMPACT, street(), 'cpu', 1)
    sys.stdout.write(f'{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.1f}\n')


def street(points: int = POINTS, fill: float = FILL) -> NDArray[np.float32]:
    """Return a street, base frame: road, two rows of houses, parked cars.

    Of the surfaces ahead so many points are taken that the image (before the occlusion filter) is
    filled by about `fill`; the rest lies behind the camera.
    """
    rng = np.random.default_rng(0)
    ahead = _surfaces(rng, 2.0, 100.0)
    camera = camera_model()
    imager = LidarImager(camera, LidarImageConfig(radius=0))
    T_camera_points = se3.inverse(T_BASE_CAMERA)
    order = rng.permutation(len(ahead))
    low, high = 0, len(ahead)
    while high - low > len(ahead) // 200:  # the fill grows with the number of points
        middle = (low + high) // 2
        seen = imager.image(ahead[order[:middle]], T_camera_points)
        if float((seen > 0).float().mean()) < fill:
            low = middle
        else:
            high = middle
    chosen = ahead[order[: min(high, points)]]
    behind = _surfaces(rng, -100.0, 2.0)
    behind = behind[rng.choice(len(behind), points - len(chosen), len(behind) < points)]
    return np.concatenate([chosen, behind]).astype(np.float32)[rng.permutation(points)]


def _surfaces(rng: np.random.Generator, near: float, far: float) -> NDArray[np.float64]:
    x = np.arange(near, far, _STEP)
    parts = [_grid(x, np.arange(-12.0, 12.0, _STEP), (0, 1, 2), 0.0)]
    parts += [_grid(x, np.arange(0.0, 8.0, _STEP), (0, 2, 1), side) for side in (-12.0, 12.0)]
    for at in np.arange(near + 3.0, far, 9.0):
        for side in (-6.0, 6.0):  # a parked car: side and top
            along = np.arange(at, min(at + 4.0, far), _STEP)
            parts.append(_grid(along, np.arange(0.2, 1.4, _STEP), (0, 2, 1), side))
            parts.append(_grid(along, side + np.arange(-0.8, 0.8, _STEP), (0, 1, 2), 1.4))
    whole = np.concatenate(parts)
    return whole + rng.uniform(-0.05, 0.05, whole.shape)


def _grid(
    one: NDArray[np.float64],
    other: NDArray[np.float64],
    columns: tuple[int, int, int],
    third: float,
) -> NDArray[np.float64]:
    a, b = np.meshgrid(one, other)
    out = np.empty((a.size, 3))
    out[:, columns[0]], out[:, columns[1]], out[:, columns[2]] = a.ravel(), b.ravel(), third
    return out
