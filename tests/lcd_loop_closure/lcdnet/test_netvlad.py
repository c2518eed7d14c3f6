"""NetVLAD and context gating against the thesis's formulas written out."""

import numpy as np
import torch

from lcd_loop_closure.lcdnet.netvlad import ContextGating, NetVlad, vlad_sums


def test_sums_are_those_of_equation_8():
    rng = np.random.default_rng(0)
    f, c = rng.normal(size=(2, 7, 5)), rng.normal(size=(3, 5))
    a = rng.dirichlet(np.ones(3), (2, 7))
    expected = np.zeros((2, 3, 5))
    for b in range(2):
        for k in range(3):
            for i in range(7):
                expected[b, k] += a[b, i, k] * (f[b, i] - c[k])
    got = vlad_sums(torch.from_numpy(f), torch.from_numpy(a), torch.from_numpy(c))
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-12)


def test_the_whole_head_is_the_plain_formula():
    torch.manual_seed(1)
    head = NetVlad(6, 4, 10).eval()
    with torch.no_grad():
        for norm in (head.assign_norm, head.compress_norm, head.gate.norm):
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.5, 2.0)
            norm.weight.normal_()
            norm.bias.normal_()
    f = torch.randn(1, 9, 6)

    def normed(x, norm):
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        return (x - norm.running_mean) * scale + norm.bias

    x = f[0]
    a = torch.exp(normed(x @ head.assign, head.assign_norm))
    a = a / a.sum(1, keepdim=True)  # equation (7)
    V = torch.stack([(a[:, k, None] * (x - head.centres[k])).sum(0) for k in range(4)])
    V = V / V.norm(dim=1, keepdim=True)
    flat = V.reshape(-1) / V.norm()
    X = normed(flat @ head.compress, head.compress_norm)
    Y = torch.sigmoid(normed(X @ head.gate.weight, head.gate.norm)) * X  # equation (9)
    torch.testing.assert_close(head(f)[0], Y / Y.norm(), atol=1e-5, rtol=1e-4)


def test_the_order_of_keypoints_does_not_matter():
    torch.manual_seed(2)
    head = NetVlad(6, 4, 10).eval()
    f = torch.randn(1, 20, 6)
    torch.testing.assert_close(head(f), head(f[:, torch.randperm(20)]), atol=1e-5, rtol=1e-4)


def test_the_gate_only_weakens():
    gate = ContextGating(8).eval()
    x = torch.randn(3, 8)
    assert bool((gate(x).abs() <= x.abs()).all())
