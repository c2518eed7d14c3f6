"""Match keypoint features softly: unbalanced optimal transport (thesis Algorithm 1)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class SoftMatches:
    """Where keypoints of one cloud lie in another.

    Attributes:
        projected: [B x N x 3] s_hat of equation (13), metres, in the other cloud's frame.
        weight: [B x N] transported mass of each keypoint.
        plan: [B x N x M].
    """

    projected: Tensor
    weight: Tensor
    plan: Tensor


def unbalanced_transport(cost: Tensor, lam: Tensor, rho: Tensor, iterations: int) -> Tensor:
    """Return the transport plan [B x N x M] of costs [B x N x M] by Algorithm 1.

    Args:
        cost: C of the thesis.
        lam: lambda, how sparse the plan is.
        rho: how much mass is preserved.
        iterations: L.
    """
    rows, columns = cost.shape[1:]
    kernel = torch.exp(-cost / lam)
    power = rho / (rho + lam)
    a, b = 1.0 / rows, 1.0 / columns
    v = cost.new_full((len(cost), columns, 1), b)
    u = cost.new_full((len(cost), rows, 1), a)
    for _ in range(iterations):
        u = (a / (kernel @ v + 1e-8)) ** power
        v = (b / (kernel.transpose(1, 2) @ u + 1e-8)) ** power
    return u * kernel * v.transpose(1, 2)


class TransportHead(nn.Module):
    """Match by the cosine of features; lambda and rho are learnt."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self.iterations = iterations
        # The authors' parametrisation: lambda = exp(e) + 0.03, rho = exp(g), both start at 0.
        self.log_lambda = nn.Parameter(torch.zeros(()))
        self.log_rho = nn.Parameter(torch.zeros(()))

    def forward(self, source: Tensor, target: Tensor, target_xyz: Tensor) -> SoftMatches:
        """Match features [B x N x D] to features [B x M x D] at points [B x M x 3]."""
        cosine = functional.normalize(source, dim=2) @ functional.normalize(
            target, dim=2
        ).transpose(1, 2)
        # In full precision: exp and powers overflow in half.
        with torch.autocast(cosine.device.type, enabled=False):
            plan = unbalanced_transport(
                1.0 - cosine.float(),
                torch.exp(self.log_lambda) + 0.03,
                torch.exp(self.log_rho),
                self.iterations,
            )
            weight = plan.sum(2)
            projected = (plan @ target_xyz.float()) / (weight[..., None] + 1e-8)
        return SoftMatches(projected, weight, plan)
