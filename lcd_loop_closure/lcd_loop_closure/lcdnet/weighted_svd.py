"""Solve for the rigid motion between matched points."""

import torch
from torch import Tensor


class _SafeSvd(torch.autograd.Function):
    """SVD of 3 x 3 matrices whose gradient stays finite where singular values meet."""

    @staticmethod
    def forward(ctx, matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[no-untyped-def]
        U, S, Vh = torch.linalg.svd(matrix)
        ctx.save_for_backward(U, S, Vh)
        return U, S, Vh

    @staticmethod
    def backward(ctx, grad_U: Tensor, grad_S: Tensor, grad_Vh: Tensor) -> Tensor:  # type: ignore[no-untyped-def, override]
        U, S, Vh = ctx.saved_tensors
        V = Vh.transpose(-1, -2)
        squared = S * S
        difference = squared[..., None, :] - squared[..., :, None]
        # 1 / (s_j^2 - s_i^2), smoothly bounded: x / (x^2 + eps) in place of 1 / x.
        scale = squared.amax(-1)[..., None, None]
        F = difference / (difference**2 + ((1e-6 * scale) ** 2).clamp(min=1e-24))
        UtgU = U.transpose(-1, -2) @ grad_U
        VtgV = V.transpose(-1, -2) @ grad_Vh.transpose(-1, -2)
        skew_u = F * (UtgU - UtgU.transpose(-1, -2))
        skew_v = F * (VtgV - VtgV.transpose(-1, -2))
        inner = skew_u * S[..., None, :] + S[..., :, None] * skew_v
        return U @ (inner + torch.diag_embed(grad_S)) @ Vh


def weighted_svd(source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return T_target_source [B x 4 x 4] that moves points onto their matches best.

    Args:
        source, target: [B x N x 3] matched points, metres.
        weight: [B x N], at least zero.
    """
    # Half precision has neither the digits nor the routines.
    with torch.autocast(source.device.type, enabled=False):
        return _solve(
            *(x if x.dtype == torch.float64 else x.float() for x in (source, target, weight))
        )


def _solve(source: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    w = (weight / weight.sum(1, keepdim=True).clamp(min=1e-12))[..., None]
    mean_source, mean_target = (w * source).sum(1), (w * target).sum(1)
    H = (w * (source - mean_source[:, None])).transpose(1, 2) @ (target - mean_target[:, None])
    U, _, Vh = _SafeSvd.apply(H)
    V, Ut = Vh.transpose(1, 2), U.transpose(1, 2)
    sign = torch.linalg.det(V.detach() @ Ut.detach()).sign()
    flip = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], -1)
    R = (V * flip[:, None]) @ Ut
    t = mean_target - (R @ mean_source[..., None])[..., 0]
    T = torch.zeros((len(R), 4, 4), dtype=R.dtype, device=R.device)
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T
