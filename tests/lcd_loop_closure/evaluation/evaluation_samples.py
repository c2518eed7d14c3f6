"""A small world with a drive through it, and a network that takes milliseconds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lcdnet_samples import TINY as SAMPLE

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.lcdnet import Lcdnet
from lcd_loop_closure.lcdnet.checkpoint import save_network

TINY = replace(
    SAMPLE,
    reach=40.0,
    group_source=(1, 2, 3, 4),
    group_radius=(2.5, 5.0, 9.0, 12.0),
    group_count=(8, 8, 8, 8),
    group_width=(8, 8, 8, 8),
    keypoints=96,
    feature_size=24,
    descriptor_size=64,
)


class World:
    """Walls, poles and ground at random; sweeps are what lies within 35 m of a pose."""

    name = 'world'

    def __init__(self, T_world_base: np.ndarray, *, seed: int = 0, intensity: bool = True) -> None:
        rng = np.random.default_rng(seed)
        low, high = T_world_base[:, :2, 3].min(0) - 40.0, T_world_base[:, :2, 3].max(0) + 40.0
        area = float(np.prod(high - low))
        poles = rng.uniform(low, high, (int(area / 60), 2))
        heights = rng.uniform(2.0, 8.0, len(poles))
        up = np.linspace(0.0, 1.0, 24)
        standing = np.repeat(poles, 24, axis=0) + rng.normal(0, 0.1, (24 * len(poles), 2))
        z = (heights[:, None] * up).ravel()
        ground = rng.uniform(low, high, (int(2.0 * area), 2))
        self._points = np.concatenate(
            [np.column_stack([standing, z]), np.column_stack([ground, np.zeros(len(ground))])]
        )
        self._shine = rng.random(len(self._points)).astype(np.float32)
        self._intensity = intensity
        self.T_world_base = T_world_base

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep."""
        T = self.T_world_base[number]
        near = np.linalg.norm(self._points[:, :2] - T[:2, 3], axis=1) < 35.0
        xyz = se3.transform_points(se3.inverse(T), self._points[near])
        return PointCloud(xyz.astype(np.float32), self._shine[near] if self._intensity else None)


def out_and_back(length_m: float = 90.0, step_m: float = 3.0) -> np.ndarray:
    """Return poses along a street and back on its other side."""
    x = np.arange(0.0, length_m, step_m)
    out, back = (np.tile(np.eye(4), (len(x), 1, 1)) for _ in range(2))
    out[:, 0, 3] = x
    back[:] = se3.rotation_z(np.pi)
    back[:, 0, 3], back[:, 1, 3] = x[::-1], 1.5
    return np.concatenate([out, back])


def tiny_network(seed: int = 0) -> Lcdnet:
    """Return a network as it is initialised."""
    torch.manual_seed(seed)
    return Lcdnet(TINY).eval()


def tiny_weights(folder: Path) -> Path:
    """Write the weights of such a network."""
    path = folder / 'tiny.safetensors'
    save_network(path, tiny_network(), {})
    return path
