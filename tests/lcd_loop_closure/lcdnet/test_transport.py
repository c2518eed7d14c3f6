"""Unbalanced optimal transport against a brute-force solver, and soft matches by the formula."""

import numpy as np
import torch
from scipy.optimize import minimize

from lcd_loop_closure.lcdnet.transport import TransportHead, unbalanced_transport


def _objective(plan, cost, lam, rho):
    """Equation (12) of the thesis, KL for masses that need not sum to one."""

    def kl(x, y):
        return np.sum(x * np.log(x / y) - x + y)

    rows, columns = cost.shape
    a, b = np.full(rows, 1 / rows), np.full(columns, 1 / columns)
    entropy = lam * np.sum(plan * (np.log(plan) - 1))
    return np.sum(cost * plan) + entropy + rho * (kl(plan.sum(1), a) + kl(plan.sum(0), b))


def test_the_fixed_point_is_the_minimum_of_equation_12():
    cost = np.random.default_rng(0).uniform(0.0, 2.0, (4, 5))
    lam, rho = 0.3, 0.7
    best = minimize(
        lambda x: _objective(np.exp(x).reshape(4, 5), cost, lam, rho),
        np.full(20, -3.0),
        method='BFGS',
        options={'gtol': 1e-9},
    )
    plan = unbalanced_transport(
        torch.from_numpy(cost)[None], torch.tensor(lam), torch.tensor(rho), 500
    )[0].numpy()
    np.testing.assert_allclose(plan, np.exp(best.x).reshape(4, 5), rtol=2e-4)
    assert _objective(plan, cost, lam, rho) <= best.fun + 1e-7


def test_few_iterations_are_those_of_algorithm_1():
    cost = np.random.default_rng(1).uniform(0.0, 2.0, (6, 3))
    lam, rho, L = 1.03, 1.0, 5
    K = np.exp(-cost / lam)
    a, b, v = np.full(6, 1 / 6), np.full(3, 1 / 3), np.full(3, 1 / 3)
    for _ in range(L):
        u = (a / (K @ v)) ** (rho / (rho + lam))
        v = (b / (K.T @ u)) ** (rho / (rho + lam))
    expected = u[:, None] * K * v[None]
    plan = unbalanced_transport(
        torch.from_numpy(cost)[None], torch.tensor(lam), torch.tensor(rho), L
    )
    np.testing.assert_allclose(plan[0].numpy(), expected, rtol=1e-5)


def test_parameters_start_where_the_authors_start_them():
    head = TransportHead(5)
    assert head.log_lambda.detach().exp().item() + 0.03 == 1.03
    assert head.log_rho.detach().exp().item() == 1.0


def test_like_features_project_onto_their_partners():
    features = torch.eye(6)[None] * 5.0
    xyz = torch.arange(18, dtype=torch.float32).reshape(1, 6, 3)
    head = TransportHead(5)
    with torch.no_grad():
        head.log_lambda.fill_(-20.0)  # lambda = 0.03: nearly one to one
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    matches = head(features[:, order], features, xyz)
    torch.testing.assert_close(matches.projected, xyz[:, order], atol=1e-3, rtol=0)
    torch.testing.assert_close(matches.weight, matches.plan.sum(2))


def test_the_gradient_reaches_lambda_and_rho():
    torch.manual_seed(0)
    head = TransportHead(5)
    matches = head(torch.randn(2, 7, 4), torch.randn(2, 9, 4), torch.randn(2, 9, 3))
    (matches.projected.square().sum() + matches.weight.square().sum()).backward()
    assert head.log_lambda.grad.abs() > 0 and head.log_rho.grad.abs() > 0
