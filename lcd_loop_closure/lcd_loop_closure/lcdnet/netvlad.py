"""Sum keypoint features up into one descriptor: NetVLAD and context gating."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

# About as large as the features of a keypoint, which are several.
_RING_WEIGHT = 2.0


class NetVlad(nn.Module):
    """Aggregate features around learnt clusters (thesis equations 7 and 8), then compress."""

    def __init__(
        self, feature_size: int, clusters: int, size: int, *, unit_length: bool = True
    ) -> None:
        """Make the layer for features [N x D], K clusters and descriptors [G]."""
        super().__init__()
        self.unit_length = unit_length
        scale = 1.0 / math.sqrt(feature_size)
        # Batch normalisation takes the place of b_k, as in the authors' code.
        self.assign = nn.Parameter(torch.randn(feature_size, clusters) * scale)
        self.assign_norm = nn.BatchNorm1d(clusters)
        self.centres = nn.Parameter(torch.randn(clusters, feature_size) * scale)
        self.compress = nn.Parameter(torch.randn(clusters * feature_size, size) * scale)
        self.compress_norm = nn.BatchNorm1d(size)
        self.gate = ContextGating(size)

    def forward(self, features: Tensor) -> Tensor:
        """Return descriptors [B x G], of unit length unless told, from features [B x N x D]."""
        clouds, number = features.shape[:2]
        scores = self.assign_norm((features @ self.assign).reshape(clouds * number, -1))
        a = torch.softmax(scores, -1).view(clouds, number, -1)
        vlad = vlad_sums(features, a, self.centres)
        vlad = functional.normalize(vlad, dim=2)  # each cluster counts alike
        flat = functional.normalize(vlad.reshape(clouds, -1), dim=1)
        gated: Tensor = self.gate(self.compress_norm(flat @ self.compress))
        return functional.normalize(gated, dim=1) if self.unit_length else gated


def vlad_sums(features: Tensor, a: Tensor, centres: Tensor) -> Tensor:
    """Return V_k = sum_i a_k(f_i) (f_i - c_k) [B x K x D] (thesis equation 8)."""
    return a.transpose(1, 2) @ features - a.sum(1)[..., None] * centres


def with_ranges(features: Tensor, keypoints: Tensor, rings: int, reach_m: float) -> Tensor:
    """Add to features [B x N x D] how near their keypoints are to each of some rings.

    Not in the thesis: a descriptor that sums up what there is, and not how far away, is nearly the
    same a few metres on. Turning the sweep changes no distance.

    Args:
        features: to be widened to [B x N x D + rings].
        keypoints: [B x N x 3], base frame, metres.
        rings: number of them, from the sensor to `reach_m`.
        reach_m: distance of the last one.
    """
    middle = torch.linspace(0.0, reach_m, rings, device=keypoints.device)
    distance = torch.linalg.vector_norm(keypoints[..., :2].float(), dim=-1, keepdim=True)
    near = torch.exp(-(((distance - middle) / (reach_m / (rings - 1))) ** 2))
    return torch.cat([features, _RING_WEIGHT * near.to(features.dtype)], -1)


class ContextGating(nn.Module):
    """Weight a vector by itself: Y = sigma(W X + b) * X (thesis equation 9)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(size, size) / math.sqrt(size))
        self.norm = nn.BatchNorm1d(size)  # brings b

    def forward(self, x: Tensor) -> Tensor:
        """Return the gated vectors [B x G]."""
        return torch.sigmoid(self.norm(x @ self.weight)) * x
