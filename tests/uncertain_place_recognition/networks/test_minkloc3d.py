"""MinkLoc3D: its size, and its numbers against dense convolution."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import turned
from torch.nn import functional

from lcd_common.errors import ConfigError
from uncertain_place_recognition.networks.minkloc3d import (
    COMPACT,
    MinkLoc3d,
    MinkLoc3dConfig,
    generalised_mean,
)


def test_the_original_has_as_many_parameters_as_published():
    assert sum(p.numel() for p in MinkLoc3d().parameters()) == 1_055_713


def _kernel(layer, size):
    """Return weights [K x I x O], x slowest, as conv3d's [O x I x X x Y x Z]."""
    taps, inputs, outputs = layer.weight.shape
    assert taps == size**3
    return layer.weight.view(size, size, size, inputs, outputs).permute(4, 3, 0, 1, 2)


def _dense(network, points, cells):
    """Run the network on a full grid: zero outside the occupied voxels after every layer."""

    def norm(x, layer):
        return functional.batch_norm(
            x, layer.running_mean, layer.running_var, layer.weight, layer.bias
        )

    def pointwise(x, linear):
        return functional.conv3d(x, linear.weight[:, :, None, None, None])

    at = torch.floor(points / network.settings.voxel).long()
    mask = torch.zeros(1, 1, cells, cells, cells)
    mask[0, 0, at[:, 0], at[:, 1], at[:, 2]] = 1.0
    masks = [mask, *(functional.max_pool3d(mask, 2**k) for k in (1, 2, 3))]
    first = network.settings.first_kernel
    x = functional.conv3d(mask, _kernel(network.first, first), padding=first // 2)
    x = norm(x, network.first_norm).relu() * masks[0]
    levels = []
    for stage, here in zip(network.stages, masks[1:], strict=True):
        x = norm(functional.conv3d(x, _kernel(stage.down, 2), stride=2), stage.down_norm)
        x = x.relu() * here
        y = norm(functional.conv3d(x, _kernel(stage.first, 3), padding=1), stage.first_norm)
        y = y.relu() * here
        y = norm(functional.conv3d(y, _kernel(stage.second, 3), padding=1), stage.second_norm)
        skip = x
        if not isinstance(stage.skip, torch.nn.Identity):
            skip = norm(pointwise(x, stage.skip[0]), stage.skip[1])
        x = (y + skip).relu() * here
        levels.append(x)
    top = pointwise(levels[2], network.top)
    up = functional.conv_transpose3d(top, _kernel(network.up, 2).transpose(0, 1), stride=2)
    x = up + pointwise(levels[1], network.lateral)
    values = x[0][:, masks[2][0, 0] > 0].clamp(min=1e-6)
    p = network.power
    return (values**p).mean(1) ** (1.0 / p)


@pytest.mark.parametrize(
    'settings',
    [
        MinkLoc3dConfig(voxel=0.25, planes=(6, 6, 5), size=7),
        MinkLoc3dConfig(voxel=0.25, first_kernel=3, planes=(4, 6, 6), size=8),
    ],
)
def test_it_is_what_dense_convolution_gives(settings):
    torch.manual_seed(0)
    network = MinkLoc3d(settings)
    cloud = torch.rand(2, 150, 3) * 4
    cloud[1, :75] = cloud[1, 75:]  # doubled points make no difference
    network.train()
    network.embed(cloud)  # running statistics that are not those at the start
    network.eval()
    with torch.no_grad():
        found = network.embed(cloud)
        expected = torch.stack([_dense(network, one, 16) for one in cloud])
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_embeddings_do_not_depend_on_the_company_or_on_the_order_of_points():
    torch.manual_seed(1)
    network = MinkLoc3d(COMPACT).eval()
    cloud = torch.rand(3, 300, 3) * 2 - 1
    with torch.no_grad():
        together = network.embed(cloud)
        alone = torch.cat([network.embed(one[None]) for one in cloud])
        shuffled = network.embed(cloud[:, torch.randperm(300)])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(together, shuffled, rtol=1e-4, atol=1e-6)


def test_a_turn_by_whole_columns_moves_polar_voxels_round():
    network = MinkLoc3d(replace(COMPACT, coordinates='polar', azimuths=64, voxel=0.05))
    rng = np.random.default_rng(0)
    azimuth = (rng.integers(0, 64, 200) + 0.5) / 64 * 2 * np.pi
    radius, height = rng.uniform(0.1, 1, 200), rng.uniform(0, 0.2, 200)
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], 1)
    both = np.stack([points, turned(points, 360.0 / 64 * 10)]).astype(np.float32)
    (one, other) = (network.prepare(torch.from_numpy(both[k : k + 1]))[0] for k in (0, 1))
    cells = [sorted(map(tuple, v.coordinates[:, 1:].tolist())) for v in (one, other)]
    assert cells[1] == sorted((r, (a + 10) % 64, z) for r, a, z in cells[0])
    assert all(0 <= a < 64 for _, a, _ in cells[0])


def test_generalised_mean_against_its_formula():
    rng = np.random.default_rng(0)
    features, batch = rng.normal(size=(9, 4)), np.array([0, 0, 0, 0, 1, 1, 3, 3, 3])
    found = generalised_mean(
        torch.tensor(features), torch.tensor(batch), 4, torch.tensor([2.5])
    ).numpy()
    for cloud in (0, 1, 3):
        clamped = np.maximum(features[batch == cloud], 1e-6)
        expected = np.mean(clamped**2.5, axis=0) ** (1 / 2.5)
        np.testing.assert_allclose(found[cloud], expected, rtol=1e-6)
    np.testing.assert_array_equal(found[2], 0.0)  # a cloud without voxels


def test_shapes_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match='odd first kernel'):
        MinkLoc3d(MinkLoc3dConfig(first_kernel=4))
    with pytest.raises(ConfigError, match='three planes'):
        MinkLoc3d(MinkLoc3dConfig(planes=(8, 8)))
