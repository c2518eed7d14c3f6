"""Small clouds and networks for the tests of LCDNet."""

import numpy as np
import torch

from lcd_loop_closure.lcdnet import LcdnetConfig
from lcd_loop_closure.lcdnet.places import PlaceShard, PlaceSweep, shard_of

TINY = LcdnetConfig(
    voxel=1.0,
    reach=24.0,
    z_low=-2.0,
    z_high=10.0,
    relative_input=True,
    channels=(8, 8, 8, 8),
    blocks=(1, 1, 1, 1),
    covered=False,
    bev_channels=4,
    group_source=(0, 1, 3),
    group_radius=(1.5, 2.5, 6.0),
    group_count=(4, 8, 8),
    group_width=(8, 8, 8),
    keypoints=48,
    feature_size=16,
    clusters=8,
    descriptor_size=32,
)


def street(rng: np.random.Generator, count: int = 3000) -> np.ndarray:
    """Return points on the ground, two walls and some poles, base frame."""
    ground = np.column_stack([rng.uniform(-22, 22, (count, 2)), rng.normal(0, 0.02, count)])
    wall_y = np.where(rng.random(count) < 0.5, -8.0, 7.0)
    wall = np.column_stack([rng.uniform(-22, 22, count), wall_y, rng.uniform(0, 6, count)])
    poles = rng.uniform(-20, 20, (6, 2))[rng.integers(0, 6, count // 4)]
    tall = np.column_stack([poles, rng.uniform(0, 5, count // 4)])
    return np.concatenate([ground, wall, tall]).astype(np.float32)


def street_shard(town: int, places: int = 4) -> PlaceShard:
    """Return places whose three sweeps are the same points seen from three poses."""
    rng = np.random.default_rng(town)
    made = []
    for _ in range(places):
        xyz = street(rng)
        corner = rng.uniform(-500.0, 500.0, 2)
        sweeps = []
        for shift in (0.0, 2.0, 8.0):
            T = np.eye(4)
            T[:2, 3] = corner + np.array([shift, 0.0])
            sweeps.append(
                PlaceSweep(
                    xyz - np.array([shift, 0.0, 0.0], np.float32),
                    rng.random(len(xyz), np.float32),
                    T,
                )
            )
        made.append(sweeps)
    return shard_of(town, made)


def unit(features: torch.Tensor) -> torch.Tensor:
    """Return rows of unit length."""
    return features / features.norm(dim=-1, keepdim=True)
