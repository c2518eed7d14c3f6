"""Check the losses against scipy's distributions and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from cmrnet_ekf.networks.losses import (
    ROTATION,
    TRANSLATION,
    LossConfig,
    evidential_loss,
    gaussian_loss,
    log_density,
    pose_losses,
    quaternion_distance,
    residual,
)
from cmrnet_ekf.networks.outputs import Evidence, GaussianPose, QuaternionPose


def evidence(seed: int = 0, count: int = 5) -> Evidence:
    rng = np.random.default_rng(seed)

    def tensor(low, high):
        return torch.tensor(rng.uniform(low, high, (count, 6)), requires_grad=True)

    return Evidence(tensor(-1, 1), tensor(0.1, 3), tensor(1.1, 4), tensor(0.01, 2))


def test_the_density_is_scipys_student_t():
    m = evidence()
    error = torch.linspace(-2, 2, 30, dtype=torch.float64).view(5, 6)
    scale = np.sqrt((m.beta * (1 + m.nu) / (m.nu * m.alpha)).detach().numpy())
    expected = stats.t.logpdf(error.numpy(), 2 * m.alpha.detach().numpy(), scale=scale)
    np.testing.assert_allclose(log_density(m, error).detach().numpy(), expected, rtol=1e-10)


def test_the_density_is_the_marginal_of_the_normal_inverse_gamma():
    """Integrate N(y; mu, s2) N(mu; gamma, s2/nu) IG(s2; alpha, beta) over mu and s2."""
    nu, alpha, beta, y = 0.7, 1.8, 0.6, 0.4

    def joint(s2):
        # The integral over mu is a Gaussian of both variances.
        normal = stats.norm.pdf(y, 0.0, np.sqrt(s2 * (1 + 1 / nu)))
        return normal * stats.invgamma.pdf(s2, alpha, scale=beta)

    expected = integrate.quad(joint, 0, np.inf)[0]
    one = Evidence(*(torch.tensor([[v] * 6], dtype=torch.float64) for v in (0, nu, alpha, beta)))
    found = log_density(one, torch.full((1, 6), y, dtype=torch.float64)).exp()
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


def smooth_l1(x):
    x = np.abs(x)
    return np.where(x < 1, 0.5 * x**2, x - 0.5)


@pytest.mark.parametrize('density', ['inverse', 'log'])
@pytest.mark.parametrize(('of', 'weight', 'unit'), [(TRANSLATION, 0.1, 0.5), (ROTATION, 0.01, 0.2)])
def test_the_evidential_loss_is_equations_28_to_30(density, of, weight, unit):
    m = evidence(1)
    settings = LossConfig(density=density, unit_translation=0.5, unit_rotation=0.2)
    error = torch.linspace(-1.5, 1.5, 30, dtype=torch.float64).view(5, 6)
    found = evidential_loss(m, error, of, settings)
    nu, alpha, beta = (v.detach().numpy()[:, of] for v in (m.nu, m.alpha, m.beta))
    e = error.numpy()[:, of] / unit
    # Errors in units of `unit` have a density of as many units.
    p = stats.t.pdf(e, 2 * alpha, scale=np.sqrt(beta * (1 + nu) / (nu * alpha)) / unit)
    if density == 'inverse':
        expected = smooth_l1(1 / np.maximum(p, 0.04)).mean()
        expected += weight * (smooth_l1(e) * (2 * nu + alpha)).mean()
    else:
        expected = (-np.log(p) + weight * np.abs(e) * (2 * nu + alpha)).mean()
    assert found.detach().item() == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize('density', ['inverse', 'log'])
def test_the_gradients_are_those_of_finite_differences(density):
    target = torch.randn(5, 6, dtype=torch.float64, generator=torch.manual_seed(3)) * 0.3

    def loss(gamma, nu, alpha, beta):
        output = Evidence(gamma, nu, alpha, beta)
        return pose_losses(output, target, LossConfig(density=density), 0.1).total

    m = evidence(2)
    assert torch.autograd.gradcheck(loss, (m.gamma, m.nu, m.alpha, m.beta))


def test_a_density_below_the_floor_counts_as_the_floor():
    one = Evidence(*(torch.full((1, 6), v) for v in (0.0, 1.0, 2.0, 1e-4)))
    settings = LossConfig(lambda_translation=0.0)
    found = evidential_loss(one, torch.full((1, 6), 50.0), TRANSLATION, settings)
    assert float(found) == pytest.approx(1 / 0.04 - 0.5, rel=1e-5)
    assert torch.isfinite(found)


def test_angles_differ_the_short_way_round():
    target = torch.tensor([[0.0, 0, 0, 3.1, -3.1, 0.2]])
    mean = torch.tensor([[1.0, 0, 0, -3.1, 3.1, 0.1]])
    gap = 2 * np.pi - 6.2
    expected = [[-1.0, 0, 0, -gap, gap, 0.1]]
    np.testing.assert_allclose(residual(target, mean).numpy(), expected, atol=1e-5)


def test_the_quaternion_distance_is_the_angle():
    from scipy.spatial.transform import Rotation

    one, other = (Rotation.random(20, rng=k) for k in (0, 1))
    q = [torch.tensor(r.as_quat()) for r in (one, other)]
    expected = (one.inv() * other).magnitude()
    np.testing.assert_allclose(quaternion_distance(*q).numpy(), expected, atol=1e-6)
    q[0] = q[0].clone().requires_grad_()
    quaternion_distance(q[0], q[0].detach()).sum().backward()
    assert torch.isfinite(q[0].grad).all(), 'no NaN where both are the same'


def test_the_gaussian_loss_is_scipys_but_for_its_constant():
    rng = np.random.default_rng(4)
    root = np.tril(rng.normal(size=(6, 6)))
    root[np.diag_indices(6)] = rng.uniform(0.5, 2, 6)
    error = rng.normal(size=6)
    covariance = np.linalg.inv(root @ root.T)
    expected = -stats.multivariate_normal.logpdf(error, cov=covariance) - 3 * np.log(2 * np.pi)
    pose = GaussianPose(torch.zeros(1, 6), torch.tensor(root)[None])
    assert float(gaussian_loss(pose, torch.tensor(error)[None])) == pytest.approx(expected)


def test_the_plain_loss_is_cmrnets():
    target = torch.tensor([[0.5, -2.0, 0.1, 0.0, 0.0, 0.2]])
    nothing = QuaternionPose(torch.zeros(1, 3), torch.tensor([[0.0, 0, 0, 1]]))
    losses = pose_losses(nothing, target, LossConfig(), 0.1)
    assert float(losses.translation) == pytest.approx(0.125 + 1.5 + 0.005)
    assert float(losses.rotation) == pytest.approx(0.2, rel=1e-5)
    assert float(losses.total) == pytest.approx(1.83, rel=1e-5)


def test_the_evidence_counts_less_in_the_second_step():
    settings = LossConfig()
    assert settings.evidence_scale(0.0) == settings.evidence_scale(149 / 400) == 0.1
    assert settings.evidence_scale(150 / 400) == settings.evidence_scale(1.0) == 0.005


def test_without_the_geometric_loss_only_evidence_is_left():
    m, target = evidence(5), torch.zeros(5, 6, dtype=torch.float64)
    settings = replace(LossConfig(), geometric=False)
    with torch.no_grad():
        losses = pose_losses(m, target, settings, 1.0)
    assert losses.total.item() == pytest.approx(losses.evidence.item())
