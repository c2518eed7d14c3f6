"""Losses against the thesis's formulas written out."""

import numpy as np
import pytest
import torch

from lcd_loop_closure.lcdnet.losses import (
    Losses,
    matching_loss,
    pose_loss,
    transport_loss,
    triplet_loss,
)
from lcd_loop_closure.lcdnet.transport import SoftMatches


def _motion(yaw, shift):
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4, dtype=np.float32)
    T[:2, :2], T[:3, 3] = [[c, -s], [s, c]], shift
    return torch.from_numpy(T)[None]


def test_hardest_triplets_are_those_of_equation_14():
    torch.manual_seed(0)
    f = torch.nn.functional.normalize(torch.randn(6, 5), dim=1)
    different = ~torch.block_diag(*[torch.ones(2, 2)] * 3).bool()
    anchor, positive = torch.tensor([0, 2, 4]), torch.tensor([1, 3, 5])
    expected = []
    for a, p in zip(anchor.tolist(), positive.tolist(), strict=True):
        nearest = min(float((f[a] - f[n]).norm()) for n in range(6) if different[a, n])
        expected.append(max(0.0, float((f[a] - f[p]).norm()) - nearest + 0.5))
    loss, violated = triplet_loss(f, anchor, positive, different, 0.5, hardest=True)
    assert float(loss) == pytest.approx(np.mean(expected), abs=1e-5)
    assert violated == pytest.approx(np.mean(np.array(expected) > 0))


def test_negatives_are_drawn_among_violating_ones_first():
    f = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [9.0, 0.0], [8.0, 0.0]])
    different = torch.ones(5, 5).bool()
    different[:2, :2] = False
    for seed in range(10):
        torch.manual_seed(seed)
        loss, _ = triplet_loss(f, torch.tensor([0]), torch.tensor([1]), different, 0.5)
        assert float(loss) == pytest.approx(0.1 - 0.2 + 0.5, abs=1e-5)


def test_without_negatives_there_is_no_loss():
    loss, violated = triplet_loss(
        torch.rand(2, 3), torch.tensor([0]), torch.tensor([1]), torch.zeros(2, 2).bool(), 0.5
    )
    assert float(loss) == 0.0 and violated == 0.0


def test_pose_and_transport_losses_are_mean_l1_distances():
    points = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    true, wrong = _motion(0.0, [1, 0, 0]), _motion(0.0, [1, 2, -3])
    assert float(pose_loss(points, wrong, true)) == pytest.approx(5.0)
    assert float(pose_loss(points, true, true)) == 0.0
    quarter = _motion(np.pi / 2, [0, 0, 0])  # (1,0,0) to (0,1,0), (0,2,0) to (-2,0,0)
    none = _motion(0.0, [0, 0, 0])
    assert float(pose_loss(points, quarter, none)) == pytest.approx((2 + 4) / 2)
    projected = torch.tensor([[[2.0, 0.5, 0.0], [1.0, 2.0, 1.0]]])
    matches = SoftMatches(projected, torch.ones(1, 2), torch.ones(1, 2, 2))
    assert float(transport_loss(matches, points, true)) == pytest.approx((0.5 + 1.0) / 2)


def test_matching_is_a_cross_entropy_over_clearly_wrong_partners():
    source = torch.tensor([[[0.0, 0, 0], [10.0, 0, 0], [50.0, 0, 0]]])
    target = torch.tensor([[[0.3, 0, 0], [1.5, 0, 0], [10.0, 0, 0], [30.0, 0, 0]]])
    cosine = torch.tensor([[[0.9, 0.8, 0.1, 0.0], [0.2, 0.0, 0.5, 0.4], [0.0, 0.1, 0.2, 0.3]]])
    got = matching_loss(cosine, source, target, _motion(0, [0, 0, 0]), temperature=0.1)
    # Row 0: partner 0; 1 is too near to be wrong. Row 1: partner 2. Row 2 has none.
    first = -np.log(np.exp(9.0) / np.exp([9.0, 1.0, 0.0]).sum())
    second = -np.log(np.exp(5.0) / np.exp([2.0, 0.0, 5.0, 4.0]).sum())
    assert float(got) == pytest.approx((first + second) / 2, rel=1e-4)
    alone = matching_loss(cosine, source + 500.0, target, _motion(0, [0, 0, 0]))
    assert float(alone) == 0.0


def test_the_sum_is_equation_17():
    losses = Losses(torch.tensor(1.0), torch.tensor(2.0), torch.tensor(40.0), 0.5)
    assert float(losses.total(0.05)) == pytest.approx(5.0)
