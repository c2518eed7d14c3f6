"""Backbones on keypoints alone: what the thesis's Table 3.8 compares PV-RCNN with."""

from itertools import pairwise

import torch
from torch import Tensor, nn


def _layer(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, outputs, bias=False), _RowNorm(outputs), nn.LeakyReLU(0.2)
    )


class _RowNorm(nn.Module):
    """Batch normalisation over all leading dimensions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(width)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(x.reshape(-1, x.shape[-1])).view(x.shape)


class PointNet(nn.Module):
    """Describe each point by itself and by the maximum over all (Qi et al., CVPR 2017).

    The spatial transformers are left out: with yaw turned at random they have no upright to learn.
    """

    def __init__(self, feature_size: int, reach_m: float) -> None:
        super().__init__()
        self.reach_m = reach_m
        self.alone = nn.Sequential(_layer(3, 64), _layer(64, 64))
        self.wide = nn.Sequential(_layer(64, 128), _layer(128, 512))
        self.out = nn.Sequential(_layer(64 + 512, 256), nn.Linear(256, feature_size))

    def forward(self, xyz: Tensor) -> Tensor:
        """Return features [B x N x D] of points [B x N x 3]."""
        alone = self.alone(xyz / self.reach_m)
        whole = self.wide(alone).amax(1, keepdim=True).expand(-1, xyz.shape[1], -1)
        return torch.as_tensor(self.out(torch.cat([alone, whole], 2)))


class EdgeConv(nn.Module):
    """Convolve over neighbours, found anew in each layer's features (DGCNN, TOG 2019)."""

    def __init__(self, feature_size: int, reach_m: float, neighbours: int = 16) -> None:
        super().__init__()
        self.reach_m, self.neighbours = reach_m, neighbours
        self.layers = nn.ModuleList([_layer(6, 64), _layer(128, 64), _layer(128, 128)])
        self.out = nn.Sequential(_layer(256, 256), nn.Linear(256, feature_size))

    def forward(self, xyz: Tensor) -> Tensor:
        """Return features [B x N x D] of points [B x N x 3]."""
        x, every = xyz / self.reach_m, []
        for layer in self.layers:
            near = _gather(x, _nearest(x, x, self.neighbours))
            centre = x[:, :, None].expand_as(near)
            x = layer(torch.cat([centre, near - centre], 3)).amax(2)
            every.append(x)
        return torch.as_tensor(self.out(torch.cat(every, 2)))


class RandlaNet(nn.Module):
    """Aggregate neighbours by attention on ever fewer points, and back (Hu et al., CVPR 2020)."""

    def __init__(
        self, feature_size: int, reach_m: float, neighbours: int = 16, levels: int = 3
    ) -> None:
        super().__init__()
        self.reach_m, self.neighbours = reach_m, neighbours
        widths = [16 * 2**level for level in range(levels + 1)]
        self.begin = _layer(3, widths[0])
        self.encode = nn.ModuleList(_Aggregation(a, b) for a, b in pairwise(widths))
        self.decode = nn.ModuleList(_layer(a + b, a) for a, b in pairwise(widths))
        self.out = nn.Sequential(_layer(widths[0], 64), nn.Linear(64, feature_size))

    def forward(self, xyz: Tensor) -> Tensor:
        """Return features [B x N x D] of points [B x N x 3]; every fourth point goes on."""
        x, points, levels = self.begin(xyz / self.reach_m), xyz, []
        for layer in self.encode:
            levels.append((points, x))
            x = layer(points, x, _nearest(points, points, self.neighbours))
            # Keypoints come in random order or farthest first: either way a fair sample.
            kept = max(1, points.shape[1] // 4)
            points, x = points[:, :kept], x[:, :kept]
        for layer, (finer, skipped) in zip(reversed(self.decode), reversed(levels), strict=True):
            x = _gather(x, _nearest(finer, points, 1))[:, :, 0]
            x, points = layer(torch.cat([skipped, x], 2)), finer
        return torch.as_tensor(self.out(x))


class _Aggregation(nn.Module):
    """Local spatial encoding and attentive pooling."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.place = _layer(6, inputs)
        self.score = nn.Linear(2 * inputs, 2 * inputs, bias=False)
        self.merge = _layer(2 * inputs, outputs)
        self.shortcut = nn.Linear(inputs, outputs)

    def forward(self, xyz: Tensor, x: Tensor, index: Tensor) -> Tensor:
        near = _gather(xyz, index)
        centre = xyz[:, :, None].expand_as(near)
        offset = near - centre
        # The paper's encoding holds absolute positions; a place must not depend on them.
        height = torch.cat([centre[..., 2:], near[..., 2:]], 3)
        coded = torch.cat([height, offset, offset.norm(dim=3, keepdim=True)], 3)
        values = torch.cat([self.place(coded), _gather(x, index)], 3)
        pooled = (torch.softmax(self.score(values), 2) * values).sum(2)
        return torch.relu(self.merge(pooled) + self.shortcut(x))


def _nearest(queries: Tensor, points: Tensor, count: int) -> Tensor:
    """Return the indices [B x N x k] of the nearest points [B x M x C] to queries [B x N x C]."""
    with torch.no_grad():
        distance = torch.cdist(queries.detach(), points.detach())
        return distance.topk(min(count, points.shape[1]), dim=2, largest=False).indices


def _gather(x: Tensor, index: Tensor) -> Tensor:
    """Return rows [B x N x k x C] of [B x M x C]."""
    clouds, number, count = index.shape
    flat = index.reshape(clouds, -1, 1).expand(-1, -1, x.shape[2])
    return torch.gather(x, 1, flat).view(clouds, number, count, -1)
