"""Draw sweeps: range images, bird's-eye views, and points over a camera frame."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from benchmarks.sweep_statistics import RINGS, RingedSweep
from lcd_common import se3

_COLUMNS, _FARTHEST_M, _REACH_M, _PIXEL_M = 870, 60.0, 40.0, 0.2
_NEAREST_M = 3.0


def side_by_side(sweeps: Mapping[str, RingedSweep], file: Path) -> None:
    """Draw each sweep as range image (colour: range) and from above (colour: height).

    Args:
        sweeps: title -> sweep, lidar frame; two of them.
        file: PNG that is written.
    """
    figure = Figure(figsize=(9.0, 7.2), dpi=110, layout='constrained')
    axes = figure.subplot_mosaic(
        [['r0', 'r0'], ['r1', 'r1'], ['b0', 'b1']], height_ratios=[1.0, 1.0, 4.6]
    )
    for k, (title, sweep) in enumerate(sweeps.items()):
        image, xyz = range_image(sweep), sweep.cloud.xyz
        axes[f'r{k}'].imshow(
            np.log(image), cmap='turbo', vmin=np.log(_NEAREST_M), vmax=np.log(_FARTHEST_M),
            aspect='auto', interpolation='nearest',
        )  # fmt: skip
        axes[f'r{k}'].set_title(f'{title}: range, back - ahead - back', fontsize=9)
        axes[f'b{k}'].imshow(
            birds_eye(xyz), cmap='viridis', vmin=-2.0, vmax=3.0, interpolation='nearest'
        )
        axes[f'b{k}'].set_title(f'{title}: {len(xyz):,} points, 80 m x 80 m', fontsize=9)
    for each in axes.values():
        each.set_xticks([])
        each.set_yticks([])
        each.set_facecolor('black')
    buffer = BytesIO()
    figure.savefig(buffer, format='png')
    save_small(Image.open(buffer).convert('RGB'), file)


def range_image(sweep: RingedSweep) -> se3.Array:
    """Return ranges [64 x 870] in metres, top beam first, ahead in the middle; NaN for none."""
    xyz = sweep.cloud.xyz
    turned = (np.pi - np.arctan2(xyz[:, 1], xyz[:, 0])) / (2 * np.pi)
    column = np.minimum((turned * _COLUMNS).astype(int), _COLUMNS - 1)
    image = np.full((RINGS, _COLUMNS), np.inf)
    np.minimum.at(image, (sweep.ring, column), np.linalg.norm(xyz, axis=1))
    return np.where(np.isfinite(image), image, np.nan)


def birds_eye(xyz: NDArray[np.float32]) -> se3.Array:
    """Return the greatest height [400 x 400] above 80 m x 80 m, ahead is up; NaN for nothing."""
    size = int(2 * _REACH_M / _PIXEL_M)
    row = np.floor((_REACH_M - xyz[:, 0]) / _PIXEL_M).astype(int)
    column = np.floor((_REACH_M - xyz[:, 1]) / _PIXEL_M).astype(int)
    inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
    image = np.full((size, size), -np.inf)
    np.maximum.at(image, (row[inside], column[inside]), xyz[inside, 2])
    return np.where(np.isfinite(image), image, np.nan)


def overlay(
    frame: NDArray[np.uint8],
    xyz: NDArray[np.float32],
    T_camera_lidar: se3.Array,
    K: NDArray[np.float64],
) -> NDArray[np.uint8]:
    """Return a frame [H x W x 3] with points of a sweep (lidar frame) on it, coloured by range."""
    p = xyz @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    p = p[p[:, 2] > 1.0]
    pixel = np.round((p @ K.T)[:, :2] / p[:, 2:]).astype(int)
    inside = (pixel >= 0).all(axis=1) & (pixel < [frame.shape[1] - 1, frame.shape[0] - 1]).all(
        axis=1
    )
    p, (u, v) = p[inside], pixel[inside].T
    range_m = np.linalg.norm(p, axis=1)
    share = np.log(range_m / _NEAREST_M) / np.log(_FARTHEST_M / _NEAREST_M)
    colours = (colormaps['turbo'](np.clip(share, 0.0, 1.0))[:, :3] * 255).astype(np.uint8)
    out = (frame * 0.6).astype(np.uint8)
    far_first = np.argsort(-range_m)
    for dv in (0, 1):
        for du in (0, 1):
            out[v[far_first] + dv, u[far_first] + du] = colours[far_first]
    return out


def save_small(image: Image.Image, file: Path) -> None:
    """Write a PNG of at most 300 kB: with fewer colours where that is needed."""
    for colours in (256, 128, 64, 32):
        image.quantize(colours, dither=Image.Dither.NONE).save(file, optimize=True)
        if file.stat().st_size < 300_000:
            return
