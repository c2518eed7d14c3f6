"""PointNetVLAD: its size, NetVLAD against its formula, and its options."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from lcd_common.errors import ConfigError
from lcd_loop_closure.lcdnet.netvlad import NetVlad
from uncertain_place_recognition.networks.pointnetvlad import (
    COMPACT,
    PORT,
    PointNetVlad,
    PointNetVladConfig,
)


def test_the_port_has_as_many_parameters_as_published():
    with torch.device('meta'):
        network = PointNetVlad(PORT)
    assert sum(p.numel() for p in network.parameters()) == 19_779_145


def test_netvlad_against_its_formula():
    torch.manual_seed(0)
    layer = NetVlad(5, 3, 4, unit_length=False)
    layer(torch.randn(8, 20, 5))
    layer.eval()
    features = torch.randn(2, 20, 5)
    with torch.no_grad():
        found = layer(features).numpy()
    state = {name: tensor.double().numpy() for name, tensor in layer.state_dict().items()}

    def norm(x, name):
        scale = state[f'{name}.weight'] / np.sqrt(state[f'{name}.running_var'] + 1e-5)
        return (x - state[f'{name}.running_mean']) * scale + state[f'{name}.bias']

    for cloud, expected_of in zip(features.double().numpy(), found, strict=True):
        score = norm(cloud @ state['assign'], 'assign_norm')
        a = np.exp(score) / np.exp(score).sum(1, keepdims=True)
        v = np.array(
            [
                sum(a[i, k] * (cloud[i] - state['centres'][k]) for i in range(len(cloud)))
                for k in range(3)
            ]
        )
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        v = v.ravel() / np.linalg.norm(v)
        y = norm(v @ state['compress'], 'compress_norm')
        y = y / (1.0 + np.exp(-norm(y @ state['gate.weight'], 'gate.norm')))
        np.testing.assert_allclose(expected_of, y, rtol=1e-4, atol=1e-6)


def test_points_are_thinned_evenly_and_their_order_does_not_matter():
    torch.manual_seed(0)
    network = PointNetVlad(replace(COMPACT, points=0)).eval()
    cloud = torch.rand(1, 256, 3)
    with torch.no_grad():
        found = network.embed(cloud)
        torch.testing.assert_close(found, network.embed(cloud[:, torch.randperm(256)]))
    assert float(found.norm()) == pytest.approx(1.0, abs=1e-5)
    few = PointNetVlad(replace(COMPACT, points=64))
    torch.testing.assert_close(few.prepare(cloud), cloud[:, ::4])


def test_options_change_what_they_say():
    torch.manual_seed(0)
    free = PointNetVlad(replace(COMPACT, unit_length=False)).eval()
    with torch.no_grad():
        norms = free.embed(torch.rand(3, 600, 3)).norm(dim=1)
    assert float((norms - 1.0).abs().min()) > 1e-3
    with_norm, without = (
        sum(p.numel() for p in PointNetVlad(replace(COMPACT, transform_norm=n)).parameters())
        for n in (True, False)
    )
    assert with_norm - without == 2 * 2 * (32 + 64 + 128 + 64 + 32)
    with pytest.raises(ConfigError, match='five widths'):
        PointNetVlad(PointNetVladConfig(widths=(3, 4)))
