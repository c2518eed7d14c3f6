from dataclasses import replace

import pytest
import torch

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import COMPACT, COMPACT_FINE, FULL, CmrnetConfig
from cmrnet_ekf.networks.outputs import Evidence, GaussianPose, QuaternionPose
from lcd_common.errors import ConfigError

SMALL = replace(
    COMPACT, width=64, height=32, pyramid=(4, 6, 8), estimator=(8, 8), hidden=16, branch=8,
    squeezed=4, pooled_rows=2, pooled_columns=4,
)  # fmt: skip


def count(module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_full_network_has_cmrnets_parameters():
    network = Cmrnet(FULL)
    assert count(network) == 37_116_287
    assert count(network.image_pyramid) == 1_665_804
    assert count(network.lidar_pyramid) == 1_665_516
    assert count(network.estimator) == 1_018_240
    assert count(network.head.shared) == 32_502_272


def test_nine_compact_networks_in_half_precision_fit_into_20_mb():
    assert 9 * 2 * count(Cmrnet(COMPACT)) < 20e6


@pytest.mark.parametrize(
    ('head', 'kind'),
    [('quaternion', QuaternionPose), ('evidential', Evidence), ('covariance', GaussianPose)],
)
def test_each_head_says_something_valid(head, kind):
    torch.manual_seed(0)
    network = Cmrnet(replace(SMALL, head=head))
    image = torch.randint(0, 256, (3, 3, 32, 64), dtype=torch.uint8)
    output = network(image, torch.rand(3, 32, 64) * 80)
    assert isinstance(output, kind)
    for value in vars(output).values():
        assert len(value) == 3 and torch.isfinite(value).all()
    if isinstance(output, QuaternionPose):
        torch.testing.assert_close(output.quaternion.norm(dim=1), torch.ones(3))
        assert (output.quaternion[:, 3] > 0.5).all(), 'it starts near no rotation'
    elif isinstance(output, Evidence):
        assert (output.nu > 0).all() and (output.alpha > 1).all() and (output.beta > 0).all()
        total = output.epistemic_variance + output.aleatoric_variance
        f = output.degrees_of_freedom
        torch.testing.assert_close(total, output.squared_scale * f / (f - 2.0))
    else:
        L = output.information_root
        torch.testing.assert_close(L, torch.tril(L))
        assert (torch.diagonal(L, dim1=1, dim2=2) > 0).all()


@pytest.mark.parametrize('head', ['quaternion', 'evidential', 'covariance'])
def test_heads_answer_in_full_precision_under_autocast(head):
    torch.manual_seed(0)
    network = Cmrnet(replace(SMALL, head=head))
    features = torch.randn(3, network.head.shared.in_features)
    expected = network.head(features)
    with torch.autocast('cpu', torch.bfloat16):
        found = network.head(features)
    for one, other in zip(vars(found).values(), vars(expected).values(), strict=True):
        assert torch.equal(one, other)


def test_all_weights_learn_from_both_images():
    torch.manual_seed(1)
    network = Cmrnet(SMALL)
    output = network(torch.randint(0, 256, (2, 3, 32, 64)), torch.rand(2, 32, 64) * 80)
    (output.translation.square().sum() + output.quaternion[:, :2].sum()).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.parameters())
    assert network.image_pyramid[0][0].weight.shape[1] == 3
    assert network.lidar_pyramid[0][0].weight.shape[1] == 1
    assert network.image_pyramid[0][0].weight.grad.abs().sum() > 0
    assert network.lidar_pyramid[0][0].weight.grad.abs().sum() > 0


@pytest.mark.parametrize(
    'broken', [{'width': 100}, {'pooled_rows': 0}, {'pyramid': ()}], ids=lambda x: str(x)
)
def test_shapes_that_do_not_fit_are_refused(broken):
    with pytest.raises(ConfigError):
        Cmrnet(replace(SMALL, **broken))


def test_the_full_configuration_is_cmrnets():
    assert CmrnetConfig() == FULL and FULL.grid == (6, 20)


def test_the_fine_network_refines_what_the_compact_one_saw():
    assert COMPACT_FINE.images == COMPACT.images
    rows, columns = COMPACT.grid
    assert COMPACT_FINE.grid == (2 * rows, 2 * columns)
    small = replace(SMALL, flow_sharpness=10.0)
    network = Cmrnet(small).eval()
    image = torch.randint(0, 256, (2, 3, 32, 64), dtype=torch.uint8)
    lidar = 30.0 * torch.rand(2, 32, 64, generator=torch.manual_seed(0))
    near = network(image, lidar).translation
    # The same correlation, but another depth.
    correlation = network.correlation(image, lidar)
    features = [network.features(correlation, depth) for depth in (lidar, 2.0 * lidar)]
    assert (features[0] - features[1]).abs().max() > 1e-4
    assert torch.equal(network.head(features[0]).translation, near)


def test_fresh_angles_are_within_what_the_loss_can_see():
    network = Cmrnet(replace(SMALL, head='evidential'))
    output = network(torch.zeros(1, 3, 32, 64), torch.full((1, 32, 64), 10.0))
    scale = output.squared_scale.detach().sqrt()[0]
    assert (scale[:3] > 0.5).all() and (scale[:3] < 2.0).all()
    assert (scale[3:] > 0.05).all() and (scale[3:] < 0.2).all()
