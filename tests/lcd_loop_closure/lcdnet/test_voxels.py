"""Mean voxel features by brute force, the cap on voxels, what lies outside."""

from dataclasses import replace

import numpy as np
import torch
from lcdnet_samples import TINY

from lcd_loop_closure.lcdnet import FULL
from lcd_loop_closure.lcdnet.voxels import Clouds, see

SMALL = replace(FULL, voxel=0.5, reach=8.0, z_low=-1.0, z_high=3.0)


def _clouds(seed=0, count=2000):
    rng = np.random.default_rng(seed)
    xyz = [torch.from_numpy(rng.uniform(-9, 9, (count, 3)).astype(np.float32)) for _ in range(2)]
    return Clouds.of(xyz, [torch.from_numpy(rng.random(count, np.float32)) for _ in range(2)])


def test_features_are_means_of_the_points_inside():
    clouds = _clouds()
    voxels = see(clouds, SMALL)
    expected: dict[tuple[int, ...], list[np.ndarray]] = {}
    for xyz, light, cloud in zip(clouds.xyz, clouds.intensity, clouds.batch, strict=True):
        cell = np.floor((xyz.numpy().astype(np.float64) - [-8, -8, -1]) / 0.5).astype(int)
        if (cell >= 0).all() and (cell < [32, 32, 8]).all():
            row = np.append(xyz.numpy(), light.numpy())
            expected.setdefault((int(cloud), *cell.tolist()), []).append(row)
    assert len(voxels.tensor) == len(expected)
    for at, features in zip(voxels.tensor.coordinates, voxels.tensor.features, strict=True):
        mean = np.mean(expected[tuple(at.tolist())], axis=0)
        np.testing.assert_allclose(features.numpy(), mean, atol=1e-5)


def test_relative_features_do_not_tell_where_a_voxel_is():
    clouds = _clouds()
    here = see(clouds, TINY)
    moved = Clouds(
        clouds.xyz + torch.tensor([4.0, -3.0, 0.0]), clouds.intensity, clouds.batch, clouds.size
    )
    there = see(moved, TINY)
    order = torch.argsort(here.xyz[:, 0] * 1e4 + here.xyz[:, 1] * 10 + here.xyz[:, 2])
    other = torch.argsort(
        (there.xyz[:, 0] - 4) * 1e4 + (there.xyz[:, 1] + 3) * 10 + there.xyz[:, 2]
    )
    assert len(order) == len(other)
    torch.testing.assert_close(
        here.tensor.features.sum(0), there.tensor.features.sum(0), rtol=1e-3, atol=0.05
    )


def test_voxels_beyond_the_cap_are_counted():
    clouds = _clouds()
    whole = see(clouds, SMALL)
    counts = torch.bincount(whole.tensor.coordinates[:, 0])
    capped = see(clouds, replace(SMALL, max_voxels=150))
    kept = torch.bincount(capped.tensor.coordinates[:, 0])
    assert kept.tolist() == [150, 150]
    assert capped.left_out == int(counts.sum()) - 300
    assert bool((capped.tensor.keys[1:] > capped.tensor.keys[:-1]).all())


def test_a_sensor_without_intensity_has_zeros():
    clouds = Clouds.of([torch.rand(10, 3)])
    assert float(clouds.intensity.abs().max()) == 0.0
