"""Rigid motions of known answer, gradients against finite differences, degenerate cases."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lcd_loop_closure.lcdnet.weighted_svd import weighted_svd


def _known(seed, count=40):
    rng = np.random.default_rng(seed)
    source = rng.normal(0.0, 10.0, (count, 3))
    R, t = Rotation.random(random_state=seed).as_matrix(), rng.normal(0.0, 5.0, 3)
    return source, R, t, rng


@pytest.mark.parametrize('seed', range(5))
def test_known_motions_come_back(seed):
    source, R, t, rng = _known(seed)
    target = source @ R.T + t
    weight = rng.uniform(0.1, 1.0, len(source))
    target[:5] += 50.0
    weight[:5] = 0.0  # wrong matches without weight do not matter
    T = weighted_svd(*(torch.from_numpy(x)[None] for x in (source, target, weight)))[0].numpy()
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-9)
    np.testing.assert_allclose(T[:3, 3], t, atol=1e-8)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_reflections_are_never_returned():
    source, R, t, _ = _known(7)
    mirrored = source @ np.diag([1.0, 1.0, -1.0]) @ R.T + t
    weight = torch.ones(1, len(source), dtype=torch.float64)
    T = weighted_svd(torch.from_numpy(source)[None], torch.from_numpy(mirrored)[None], weight)
    assert float(torch.linalg.det(T[0, :3, :3])) == pytest.approx(1.0)


def test_gradients_are_those_of_finite_differences():
    source, R, t, rng = _known(3, 6)
    target = torch.from_numpy(source @ R.T + t + rng.normal(0.0, 0.5, source.shape))[None]
    weight = torch.from_numpy(rng.uniform(0.2, 1.0, 6))[None]
    given = [torch.from_numpy(source)[None], target, weight]
    for one in given:
        one.requires_grad_()
    assert torch.autograd.gradcheck(weighted_svd, given, atol=1e-5)


@pytest.mark.parametrize('kind', ['one point', 'line', 'cube'])
def test_gradients_stay_finite_where_singular_values_meet(kind):
    source = {
        'one point': np.ones((8, 3)),
        'line': np.outer(np.arange(8.0), [1.0, 0.0, 0.0]),
        'cube': np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float),
    }[kind]
    given = torch.from_numpy(source)[None].float().requires_grad_()
    T = weighted_svd(given, torch.from_numpy(source)[None].float() + 1.0, torch.ones(1, 8))
    T.square().sum().backward()
    assert bool(torch.isfinite(T).all()) and bool(torch.isfinite(given.grad).all())
