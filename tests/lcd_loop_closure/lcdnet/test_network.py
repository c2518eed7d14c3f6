"""The whole network: what it must not depend on, sizes, and learning by gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lcdnet_samples import TINY, street

from lcd_common.errors import ConfigError
from lcd_loop_closure.lcdnet import COMPACT, FULL, Lcdnet, LcdnetConfig
from lcd_loop_closure.lcdnet.voxels import Clouds


def _parameters(module):
    return sum(p.numel() for p in module.parameters())


def _network(settings=TINY):
    torch.manual_seed(0)
    return Lcdnet(settings).eval()


def _cloud(seed):
    return torch.from_numpy(street(np.random.default_rng(seed)))


@torch.no_grad()
def test_the_order_of_points_does_not_matter():
    network, xyz = _network(), _cloud(0)
    shuffled = xyz[torch.randperm(len(xyz), generator=torch.Generator().manual_seed(0))]
    a, b = network(Clouds.of([xyz])), network(Clouds.of([shuffled]))
    # The group around points draws by rank; its input order may swap equal ones.
    torch.testing.assert_close(a.descriptors, b.descriptors, atol=2e-4, rtol=1e-3)
    torch.testing.assert_close(a.keypoints, b.keypoints, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_a_batch_gives_what_its_clouds_give_alone():
    network = _network()
    clouds = [_cloud(seed) for seed in (1, 2, 3)]
    together = network(Clouds.of(clouds))
    for number, cloud in enumerate(clouds):
        alone = network(Clouds.of([cloud]))
        # Coarse voxels lie on a lattice: the tree orders equally distant ones as it likes.
        same = (together.features[number] - alone.features[0]).abs().amax(1) < 1e-5
        assert float(same.float().mean()) > 0.9
        torch.testing.assert_close(
            together.descriptors[number], alone.descriptors[0], atol=1e-3, rtol=0
        )
        assert torch.equal(together.keypoints[number], alone.keypoints[0])


@torch.no_grad()
def test_normalisations_that_are_constants_are_those_of_the_layers():
    rng = torch.Generator().manual_seed(0)
    network = _network()
    for norm in (m for m in network.modules() if isinstance(m, torch.nn.BatchNorm1d)):
        for values in (norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var):
            values.copy_(torch.rand(values.shape, generator=rng) + 0.5)
    clouds = Clouds.of([_cloud(0)])
    with torch.no_grad():
        folded = network(clouds).features
        # Batch normalisation alone at rest: the layers themselves take the way of training.
        for module in network.modules():
            module.training = not isinstance(module, torch.nn.BatchNorm1d)
        layer_by_layer = network(clouds).features
    torch.testing.assert_close(folded, layer_by_layer, rtol=1e-4, atol=1e-5)


def test_keypoints_are_structure_and_descriptors_have_unit_length():
    network = _network(replace(TINY, keypoint_height=0.5))
    found = network(Clouds.of([_cloud(4)]), keypoints=30)
    assert found.keypoints.shape == (1, 30, 3) and found.features.shape == (1, 30, 16)
    assert float(found.keypoints[..., 2].min()) > 0.4
    assert float(found.descriptors.detach().norm()) == pytest.approx(1.0, abs=1e-5)


@torch.no_grad()
def test_clouds_without_structure_or_points_are_described_all_the_same():
    network = _network(replace(TINY, keypoint_height=0.5))
    flat = torch.rand(500, 3) * torch.tensor([20.0, 20.0, 0.05])
    for cloud in (flat, torch.zeros(0, 3), torch.full((5, 3), 500.0)):
        found = network(Clouds.of([flat, cloud]))
        assert bool(torch.isfinite(found.descriptors).all())


def _by_hand(s):
    """Count the parameters of a network from its widths."""
    inputs, total = 6 if s.relative_input else 4, 0
    for level, (width, blocks) in enumerate(zip(s.channels, s.blocks, strict=True)):
        for _ in range(blocks + (level > 0)):
            total += 27 * inputs * width + 2 * width
            inputs = width
    total += 3 * inputs * s.bev_channels + 2 * s.bev_channels
    widths = (2, *s.channels)
    for source, width in zip(s.group_source, s.group_width, strict=True):
        total += (widths[source] + 3) * width + width * width + 4 * width
    layers = {0.1: 2, 0.5: 1}[s.voxel]  # of the view from above
    D, K, G = s.feature_size, s.clusters, s.descriptor_size
    total += (sum(s.group_width) + layers * s.bev_channels) * D + 2 * D
    return total + 2 * D * K + 2 * K + K * D * G + 2 * G + G * G + 2 * G + 2


def test_parameters_are_as_many_as_stated():
    full, compact = Lcdnet(FULL), Lcdnet(COMPACT)
    assert full.pyramid.bev_size == 256
    assert full.abstraction.merge.in_features == 640
    assert _parameters(full) == _by_hand(FULL) == 11_798_274
    assert _parameters(compact) == _by_hand(COMPACT) == 2_744_194


@torch.no_grad()
def test_the_full_network_runs_on_a_small_cloud():
    network = Lcdnet(FULL).eval()
    found = network(Clouds.of([_cloud(5)]), keypoints=64)
    assert found.features.shape == (1, 64, 640) and found.descriptors.shape == (1, 256)


def test_tables_that_do_not_fit_are_told():
    with pytest.raises(ConfigError, match='one row each'):
        Lcdnet(replace(TINY, group_count=(4, 8)))
    with pytest.raises(ConfigError, match='one for each level'):
        Lcdnet(replace(TINY, channels=(8, 8)))
    with pytest.raises(ConfigError, match='above z_low'):
        Lcdnet(replace(TINY, z_low=20.0))
    with pytest.raises(ConfigError, match='backbone must be one of'):
        LcdnetConfig(backbone='vgg')
