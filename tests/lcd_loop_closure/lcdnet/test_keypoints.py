"""Farthest point sampling and height above ground against brute force."""

import numpy as np
import torch

from lcd_loop_closure.lcdnet.keypoints import above_ground, farthest_points


def _brute_force(xyz, count, first):
    chosen = [first]
    for _ in range(count - 1):
        distance = np.linalg.norm(xyz[:, None] - xyz[chosen][None], axis=2).min(1)
        chosen.append(int(distance.argmax()))
    return chosen


def test_points_are_those_of_brute_force():
    xyz = np.random.default_rng(0).normal(0.0, 20.0, (700, 3)).astype(np.float32)
    begun = set()
    for first in (0, 17, 300):
        chosen = farthest_points(torch.from_numpy(xyz), 60, first).tolist()
        assert chosen == _brute_force(xyz, 60, chosen[0])
        assert chosen == farthest_points(torch.from_numpy(xyz), 60, first).tolist()
        begun.add(chosen[0])
    assert len(begun) > 1


def test_small_clouds_repeat():
    chosen = farthest_points(torch.zeros(3, 3), 7)
    assert chosen.tolist() == [0, 1, 2, 0, 1, 2, 0]


def test_structure_stands_above_the_ground_of_a_hill():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-30, 30, (6000, 2))
    slope = 0.1 * xy[:, 0]
    ground = np.column_stack([xy, slope])
    posts = rng.uniform(-28, 28, (40, 2))
    tall = np.column_stack([posts, 0.1 * posts[:, 0] + 2.0])
    xyz = torch.from_numpy(np.concatenate([ground, tall]).astype(np.float32))
    mask = above_ground(xyz, 0.7).numpy()
    assert mask[6000:].all()
    assert mask[:6000].mean() < 0.01


def test_height_is_that_of_brute_force():
    rng = np.random.default_rng(2)
    xyz = rng.uniform(-9, 9, (300, 3)).astype(np.float32)
    cell = np.floor(xyz[:, :2] / 2.0)
    expected = [
        z - xyz[(np.abs(cell - own) <= 1).all(1), 2].min() >= 1.5
        for own, z in zip(cell, xyz[:, 2], strict=True)
    ]
    assert above_ground(torch.from_numpy(xyz), 1.5).tolist() == expected
    assert len(above_ground(torch.zeros(0, 3), 1.0)) == 0
