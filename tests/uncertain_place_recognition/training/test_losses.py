"""Losses against brute force over all triplets and quadruplets."""

import numpy as np
import pytest
import torch

from uncertain_place_recognition.training.losses import (
    batch_hard_triplet,
    contrastive,
    distances,
    distillation,
    gaussian_likelihood,
    lazy_quadruplet,
    truncated_smooth_ap,
)


def _batch(seed=0, size=12, scale=1.0):
    """Return embeddings and masks: five places, one seen once, one pair that teaches nothing."""
    torch.manual_seed(seed)
    embeddings = (scale * torch.randn(size, 5)).double().requires_grad_()
    place = torch.tensor([0, 0, 0, 1, 1, 2, 2, 2, 3, 4, 4, 4])[:size]
    same = place[:, None] == place
    positive = same & ~torch.eye(size, dtype=torch.bool)
    negative = ~same
    negative[0, 5] = negative[5, 0] = False  # between the radii
    return embeddings, positive, negative


def _distance(x):
    x = x.detach().numpy()
    return np.linalg.norm(x[:, None] - x, axis=2)


@pytest.mark.parametrize('scale', [0.05, 0.3, 3.0])
def test_batch_hard_triplets_with_swap(scale):
    embeddings, positive, negative = _batch(scale=scale)
    d, losses, anchors = _distance(embeddings), [], 0
    for a in range(12):
        p_of = [p for p in range(12) if positive[a, p]]
        n_of = [n for n in range(12) if negative[a, n]]
        if not p_of:
            continue
        anchors += 1
        p, n = max(p_of, key=lambda p: d[a, p]), min(n_of, key=lambda n: d[a, n])
        losses.append(max(0.0, d[a, p] - min(d[a, n], d[p, n]) + 0.2))
    active = [one for one in losses if one > 0]
    found = batch_hard_triplet(embeddings, positive, negative, 0.2)
    assert float(found.loss.detach()) == pytest.approx(np.mean(active), rel=1e-6)
    assert found.active == pytest.approx(len(active) / anchors)


def test_gradients_are_numbers_where_embeddings_coincide_and_without_triplets():
    embeddings = torch.zeros(4, 3, requires_grad=True)
    positive = torch.block_diag(torch.ones(2, 2), torch.ones(2, 2)).bool() & ~torch.eye(4).bool()
    negative = ~positive & ~torch.eye(4).bool()
    nothing = torch.zeros(4, 4, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    for masks in ((positive, negative), (nothing, negative), (positive, nothing)):
        for found in (
            batch_hard_triplet(embeddings, *masks),
            lazy_quadruplet(embeddings, *masks, generator),
            truncated_smooth_ap(embeddings, *masks),
            contrastive(embeddings, *masks),
        ):
            (gradient,) = torch.autograd.grad(found.loss, embeddings)
            assert torch.isfinite(gradient).all()
            assert np.isfinite(float(found.loss.detach()))


def test_lazy_quadruplets():
    embeddings, positive, negative = _batch(scale=0.4)
    squared = _distance(embeddings) ** 2
    drawn = torch.rand(12, 12, generator=torch.Generator().manual_seed(3)).numpy()
    losses = []
    for a in range(12):
        p_of = [p for p in range(12) if positive[a, p]]
        n_of = [n for n in range(12) if negative[a, n]]
        if not p_of:
            continue
        near = min(squared[a, p] for p in p_of)
        other = max(n_of, key=lambda n: drawn[a, n])
        first = max(max(0.0, 0.5 + near - squared[a, n]) for n in n_of)
        meets = [n for n in n_of if negative[other, n]]
        second = max((max(0.0, 0.2 + near - squared[other, n]) for n in meets), default=0.0)
        losses.append(first + second)
    found = lazy_quadruplet(
        embeddings, positive, negative, torch.Generator().manual_seed(3), (0.5, 0.2)
    )
    assert float(found.loss.detach()) == pytest.approx(np.mean(losses), rel=1e-6)


def test_smooth_average_precision_is_that_of_the_ranking_when_sharp():
    embeddings, positive, negative = _batch(scale=1.0)
    d, precisions = _distance(embeddings), []
    for a in range(12):
        p_of = sorted((p for p in range(12) if positive[a, p]), key=lambda p: d[a, p])[:4]
        for p in p_of:
            ahead_p = sum(1 for q in range(12) if positive[a, q] and q != p and d[a, q] < d[a, p])
            ahead_n = sum(1 for q in range(12) if negative[a, q] and d[a, q] < d[a, p])
            precisions.append((1 + ahead_p) / (1 + ahead_p + ahead_n))
    found = truncated_smooth_ap(embeddings, positive, negative, temperature=1e-6)
    assert 1.0 - float(found.loss.detach()) == pytest.approx(np.mean(precisions), rel=1e-6)
    # And smooth: the gradient is that of finite differences.
    torch.autograd.gradcheck(
        lambda x: truncated_smooth_ap(x, positive, negative, temperature=0.3).loss, embeddings
    )


def test_the_contrastive_loss_counts_every_negative_of_every_pair():
    embeddings, positive, negative = _batch()
    x = embeddings.detach().numpy()
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    losses, wrong = [], []
    for a in range(12):
        n_of = [float(x[a] @ x[n]) for n in range(12) if negative[a, n]]
        p_of = [float(x[a] @ x[p]) for p in range(12) if positive[a, p]]
        losses += [np.log1p(sum(np.exp((n - p) / 0.2) for n in n_of)) for p in p_of]
        wrong += [max(n_of) > max(p_of)] if p_of else []
    found = contrastive(embeddings, positive, negative, temperature=0.2)
    assert float(found.loss.detach()) == pytest.approx(np.mean(losses), rel=1e-6)
    assert found.active == pytest.approx(np.mean(wrong))


def test_students_losses_against_their_formulas():
    rng = np.random.default_rng(0)
    s, t, v = rng.normal(size=(3, 4, 6)) * [[[1.0]], [[2.0]], [[1.0]]]
    v = np.abs(v) + 0.1
    gap = np.abs(s - t)
    smooth = np.where(gap < 1.0, 0.5 * gap**2, gap - 0.5).sum(1).mean()
    assert float(distillation(torch.tensor(s), torch.tensor(t))) == pytest.approx(smooth)
    expected = ((t - s) ** 2 / (2 * v) + 0.5 * np.log(v)).sum(1).mean()
    found = gaussian_likelihood(*(torch.tensor(x) for x in (s, v, t)))
    assert float(found) == pytest.approx(expected)


def test_small_distances_of_long_embeddings_are_kept():
    x = torch.full((2, 64), 30.0)
    x[1, 0] += 1e-3
    assert float(distances(x)[0, 1]) == pytest.approx(1e-3, rel=1e-2)
