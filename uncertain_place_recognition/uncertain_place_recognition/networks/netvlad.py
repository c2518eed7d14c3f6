"""NetVLAD with context gating, as PointNetVLAD has it; where its ports deviate is an option."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from lcd_loop_closure.lcdnet.netvlad import ContextGating, vlad_sums


class NetVlad(nn.Module):
    """Aggregate local features around learnt clusters into one vector of any length.

    Arandjelovic et al., CVPR 2016; intra-normalised, compressed, gated.
    """

    def __init__(self, feature_size: int, clusters: int, size: int) -> None:
        """Make the layer for features [N x C], K clusters and vectors [D]."""
        super().__init__()
        scale = 1.0 / math.sqrt(feature_size)
        self.assign = nn.Parameter(torch.randn(feature_size, clusters) * scale)
        self.assign_norm = nn.BatchNorm1d(clusters)
        self.centres = nn.Parameter(torch.randn(clusters, feature_size) * scale)
        self.compress = nn.Parameter(torch.randn(clusters * feature_size, size) * scale)
        self.compress_norm = nn.BatchNorm1d(size)
        self.gate = ContextGating(size)

    def forward(self, features: Tensor) -> Tensor:
        """Return vectors [B x D] of features [B x N x C]."""
        clouds, number = features.shape[:2]
        scores = self.assign_norm((features @ self.assign).reshape(clouds * number, -1))
        a = torch.softmax(scores, -1).view(clouds, number, -1)
        vlad = functional.normalize(vlad_sums(features, a, self.centres), dim=2)
        flat = functional.normalize(vlad.reshape(clouds, -1), dim=1)
        gated: Tensor = self.gate(self.compress_norm(flat @ self.compress))
        return gated
