from dataclasses import replace

import numpy as np
import pytest
import torch

from cmrnet_ekf.networks import checkpoint
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.pose_belief import gaussian_of_samples, joined
from cmrnet_ekf.predictors import Predictor, means
from lcd_common.errors import ConfigError, DataError

SMALL = replace(
    COMPACT, width=64, height=32, pyramid=(4, 6, 8), estimator=(8, 8), hidden=16, branch=8,
    squeezed=4, pooled_rows=2, pooled_columns=4,
)  # fmt: skip


def network(seed: int = 0, **changes) -> Cmrnet:
    torch.manual_seed(seed)
    return Cmrnet(replace(SMALL, **changes)).eval()


@pytest.fixture
def images():
    generator = torch.manual_seed(1)
    image = torch.randint(0, 256, (2, 3, 32, 64), generator=generator)
    return image, torch.rand(2, 32, 64, generator=generator) * 80


def test_dropout_samples_from_one_pass_through_the_trunk(images, monkeypatch):
    one = network(dropout=0.3)
    calls = []
    trunk = one.trunk
    monkeypatch.setattr(one, 'trunk', lambda *a: calls.append(1) or trunk(*a))
    predictor = Predictor([one], samples=400)
    belief = predictor.belief(*images)
    assert predictor.kind == 'mcd' and len(calls) == 1
    assert (belief.scale > 0).all()
    again = predictor.belief(*images)
    np.testing.assert_array_equal(belief.mean, again.mean)
    # The same draws, one by one, with numpy's mean and variance.
    with torch.no_grad():
        features = trunk(*images)
        torch.manual_seed(0)
        one.head.dropout.train()
        draws = means(one.head(features.repeat(400, 1))).reshape(400, 2, 6)
        one.head.dropout.eval()
    np.testing.assert_allclose(belief.mean, draws.mean(0), atol=1e-9)
    np.testing.assert_allclose(belief.variance, draws.var(0), rtol=1e-6)


def test_sampling_leaves_the_random_numbers_of_others_alone(images):
    predictor = Predictor([network(dropout=0.3)], samples=5)
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    predictor.belief(*images)
    assert torch.equal(torch.rand(1), expected)


def test_an_ensemble_is_the_mean_and_spread_of_its_members(images):
    members = [network(seed) for seed in range(5)]
    belief = Predictor(members).belief(*images)
    with torch.no_grad():
        each = np.stack([means(member(*images)) for member in members])
    np.testing.assert_allclose(belief.mean, each.mean(0), atol=1e-9)
    np.testing.assert_allclose(belief.scale, each.std(0), rtol=1e-6)
    assert np.isinf(belief.freedom).all()


def test_means_of_angles_go_the_short_way_round():
    samples = np.zeros((2, 1, 6))
    samples[:, 0, 5] = [np.pi - 0.1, -np.pi + 0.3]
    belief = gaussian_of_samples(samples)
    assert belief.mean[0, 5] == pytest.approx(-np.pi + 0.1)
    assert belief.scale[0, 5] == pytest.approx(0.2)


def test_evidence_becomes_a_student_t_law(images):
    one = network(head='evidential')
    belief = Predictor([one]).belief(*images)
    with torch.no_grad():
        m = one(*images)
    np.testing.assert_allclose(belief.freedom, 2 * m.alpha, rtol=1e-6)
    variance = m.beta * (1 + m.nu) / (m.nu * (m.alpha - 1))
    np.testing.assert_allclose(belief.variance, variance, rtol=1e-4)
    np.testing.assert_allclose(belief.epistemic, m.beta / (m.nu * (m.alpha - 1)), rtol=1e-4)


def test_a_covariance_head_keeps_its_correlations(images):
    one = network(head='covariance')
    belief = Predictor([one]).belief(*images)
    with torch.no_grad():
        root = one(*images).information_root.double().numpy()
    np.testing.assert_allclose(
        belief.covariance @ root @ np.swapaxes(root, 1, 2),
        np.broadcast_to(np.eye(6), (2, 6, 6)), atol=1e-6,
    )  # fmt: skip
    both = joined([belief, belief.row(1)])
    assert len(both) == 3 and both.covariance.shape == (3, 6, 6)


def test_a_plain_network_does_not_pretend_to_know(images):
    predictor = Predictor([network()])
    assert predictor.kind == 'plain'
    assert not predictor.belief(*images).scale.any()


def test_networks_come_back_from_their_files(images, tmp_path):
    for seed in range(2):
        checkpoint.save_network(
            tmp_path / f'{seed}.safetensors', network(seed), {'a': 1}, half=True
        )
    pair, one = Predictor.load(tmp_path), Predictor.load(tmp_path / '0.safetensors')
    assert pair.kind == 'de' and one.kind == 'plain'
    np.testing.assert_allclose(
        one.belief(*images).mean, Predictor([network(0)]).belief(*images).mean, atol=2e-2
    )
    (tmp_path / 'broken.safetensors').write_bytes(b'nothing')
    with pytest.raises(DataError, match='train_cmrnet'):
        Predictor.load(tmp_path / 'broken.safetensors')
    with pytest.raises(DataError, match='found none'):
        Predictor.load(tmp_path / 'absent')


def test_networks_that_do_not_fit_together_are_refused():
    with pytest.raises(ConfigError, match='same images'):
        Predictor([network(), network(width=128)])
    with pytest.raises(ConfigError, match='quaternion'):
        Predictor([network(), network(head='evidential')])
    with pytest.raises(ConfigError, match='at least one'):
        Predictor([])
