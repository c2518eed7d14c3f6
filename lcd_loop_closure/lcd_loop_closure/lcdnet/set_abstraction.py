"""Bring all feature maps onto keypoints: voxel set abstraction (thesis equations 2 to 6)."""

from itertools import groupby

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from lcd_loop_closure.lcdnet.config import LcdnetConfig
from lcd_loop_closure.lcdnet.grouping import ball_query
from lcd_loop_closure.lcdnet.pyramid import Pyramid, fixed
from lcd_loop_closure.lcdnet.voxels import Clouds, Voxels

_AT_ONCE = 256  # keypoints


class BallAbstraction(nn.Module):
    """Abstract the neighbours in a ball: MaxPool(MLP(features and offsets)), equation (2).

    The first layer is linear in feature and offset, so it runs once for each source point and once
    for each keypoint, not once for each pair: W [f; v - k] = W_f f + W_x v - W_x k.
    """

    def __init__(self, inputs: int, width: int, radius_m: float, count: int) -> None:
        super().__init__()
        self.radius_m, self.count = radius_m, count
        self.of_feature = nn.Linear(inputs, width, bias=False)
        self.of_offset = nn.Linear(3, width, bias=False)
        self.norm = nn.BatchNorm1d(width, eps=1e-3)
        self.second = nn.Linear(width, width, bias=False)
        self.second_norm = nn.BatchNorm1d(width, eps=1e-3)

    def forward(
        self, xyz: Tensor, features: Tensor, keypoints: Tensor, index: Tensor, valid: Tensor
    ) -> Tensor:
        """Return [N x width] for keypoints [N x 3] with neighbours [N x count] in xyz [M x 3]."""
        # In radii: offsets of every ball are then of one order.
        at_source = self.of_feature(features) + self.of_offset(xyz / self.radius_m)
        at_keypoint = self.of_offset(keypoints / self.radius_m)
        (n, count), width = index.shape, at_source.shape[1]
        if self.training:
            hidden = at_source.index_select(0, index.reshape(-1)).view(n, count, width)
            hidden = (hidden - at_keypoint[:, None]).view(-1, width)
            hidden = self.second_norm(self.second(torch.relu(self.norm(hidden))))
            pooled = torch.relu(hidden).view(n, count, width).amax(1)
        else:
            # The same with both normalisations, constants now, where there are fewest numbers.
            scale, shift = fixed(self.norm)
            at_source, at_keypoint = at_source * scale + shift, at_keypoint * scale
            scale, shift = fixed(self.second_norm)
            second, parts = self.second.weight * scale[:, None], []
            # In parts that stay in the cache.
            for near, at in zip(index.split(_AT_ONCE), at_keypoint.split(_AT_ONCE), strict=True):
                hidden = at_source.index_select(0, near.reshape(-1)).view(-1, count, width)
                hidden = functional.linear(torch.relu(hidden - at[:, None]), second)
                parts.append(hidden.amax(1))
            pooled = torch.relu(torch.cat(parts) + shift)
        return pooled * valid[:, :1]  # an empty ball says nothing


class VoxelSetAbstraction(nn.Module):
    """Make keypoint features [N x D] of a pyramid."""

    def __init__(self, settings: LcdnetConfig, bev_size: int) -> None:
        super().__init__()
        s = self.settings = settings
        widths = (1 + int(s.use_intensity), *s.channels)
        self.balls = nn.ModuleList(
            BallAbstraction(widths[source], width, radius, count)
            for source, width, radius, count in zip(
                s.group_source, s.group_width, s.group_radius, s.group_count, strict=True
            )
        )
        total = sum(s.group_width) + bev_size
        self.merge = nn.Linear(total, s.feature_size, bias=False)
        self.norm = nn.BatchNorm1d(s.feature_size)

    def forward(
        self,
        clouds: Clouds,
        voxels: Voxels,
        pyramid: Pyramid,
        keypoints: Tensor,
        batch: Tensor,
        generator: np.random.Generator | None = None,
    ) -> Tensor:
        """Return features [N x D] of keypoints [N x 3], cloud `batch` [N] each.

        With a generator, neighbours are drawn at random where a ball holds more than are taken.
        """
        rows = list(zip(self.settings.group_source, self.balls, strict=True))
        parts: list[Tensor] = []
        for source, of_source in groupby(rows, key=lambda row: row[0]):
            balls = [ball for _, ball in of_source]
            xyz, features, of = self._source(source, clouds, voxels, pyramid)
            neighbours = ball_query(
                xyz,
                keypoints,
                [(ball.radius_m, ball.count) for ball in balls],
                points_batch=of,
                centres_batch=batch,
                generator=generator,
            )
            parts += [
                ball(xyz, features, keypoints, *near)
                for ball, near in zip(balls, neighbours, strict=True)
            ]
        parts.append(self._from_above(pyramid.bev, keypoints, batch))
        return torch.relu(self.norm(self.merge(torch.cat(parts, 1))))

    def _source(
        self, source: int, clouds: Clouds, voxels: Voxels, pyramid: Pyramid
    ) -> tuple[Tensor, Tensor, Tensor]:
        s = self.settings
        if source == 0:
            height = 0.2 * clouds.xyz[:, 2:]
            seen = [height, clouds.intensity[:, None]] if s.use_intensity else [height]
            return clouds.xyz, torch.cat(seen, 1), clouds.batch
        level = pyramid.levels[source - 1]
        at = level.coordinates
        if source == 1:
            return voxels.xyz, level.features, at[:, 0]
        low = voxels.xyz.new_tensor([-s.reach, -s.reach, s.z_low])
        xyz = (at[:, 1:] + 0.5) * (s.voxel * 2 ** (source - 1)) + low
        return xyz.to(level.features.dtype), level.features, at[:, 0]

    def _from_above(self, bev: Tensor, keypoints: Tensor, batch: Tensor) -> Tensor:
        """Interpolate the view from above [B x C x X x Y] at keypoints, bilinear."""
        s, out = self.settings, bev.new_zeros((len(keypoints), bev.shape[1]))
        # grid_sample wants (column, row) = (y, x) in -1 .. 1 over the cells' outer edges.
        span = s.voxel * 2 ** (s.levels - 1)
        size = keypoints.new_tensor([bev.shape[3] * span, bev.shape[2] * span])
        at = 2.0 * (keypoints[:, [1, 0]] + s.reach) / size - 1.0
        for cloud in range(len(bev)):
            rows = torch.nonzero(batch == cloud)[:, 0]
            sampled = functional.grid_sample(
                bev[cloud : cloud + 1], at[rows][None, :, None].to(bev.dtype), align_corners=False
            )
            out = out.index_copy(0, rows, sampled[0, :, :, 0].T)
        return out
