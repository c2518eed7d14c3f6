"""Four levels of sparse convolution and the view from above (PV-RCNN's voxel network)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lcd_common.sparse import SparseConv3d, SparseTensor, SubmanifoldConv3d
from lcd_loop_closure.lcdnet.config import LcdnetConfig
from lcd_loop_closure.lcdnet.voxels import Voxels, input_channels


@dataclass(frozen=True)
class Pyramid:
    """Feature maps of a batch.

    Attributes:
        levels: four tensors, at 1x 2x 4x 8x of the voxel.
        bev: [B x C x X x Y], the coarsest level seen from above, layers stacked along z.
    """

    levels: tuple[SparseTensor, ...]
    bev: Tensor


def fixed(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return the scale and shift that a batch normalisation is once it is trained."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return scale, norm.bias - norm.running_mean * scale


class _Normalised(nn.Module):
    """A convolution, batch normalisation and ReLU."""

    def __init__(self, convolution: SubmanifoldConv3d | SparseConv3d, channels: int) -> None:
        super().__init__()
        self.convolution = convolution
        self.norm = nn.BatchNorm1d(channels, eps=1e-3)

    def forward(self, tensor: SparseTensor) -> SparseTensor:
        if self.training:
            tensor = self.convolution(tensor)
            return tensor.with_features(torch.relu(self.norm(tensor.features)))
        scale, shift = fixed(self.norm)
        tensor = self.convolution(tensor, scale)
        return tensor.with_features(torch.relu(tensor.features + shift))


class VoxelPyramid(nn.Module):
    """Convolve voxels level by level."""

    def __init__(self, settings: LcdnetConfig) -> None:
        super().__init__()
        self.settings = settings
        inputs, levels = input_channels(settings), []
        for level, (width, blocks) in enumerate(
            zip(settings.channels, settings.blocks, strict=True)
        ):
            layers: list[nn.Module] = []
            if level:
                down = SparseConv3d(inputs, width, 3, 2, covered=settings.covered)
                layers.append(_Normalised(down, width))
            for block in range(blocks):
                before = inputs if not level and not block else width
                layers.append(_Normalised(SubmanifoldConv3d(before, width), width))
            levels.append(nn.Sequential(*layers))
            inputs = width
        self.levels = nn.ModuleList(levels)
        # conv_out of PV-RCNN: along z alone, padded by nothing.
        flatten = SparseConv3d(inputs, settings.bev_channels, (1, 1, 3), (1, 1, 2), 0)
        self.flatten = _Normalised(flatten, settings.bev_channels)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Size of the view from above: cells along x and y, layers along z."""
        s = self.settings
        sizes = [round(2 * s.reach / s.voxel)] * 2 + [round((s.z_high - s.z_low) / s.voxel)]
        for _ in range(s.levels - 1):
            sizes = [(size + 1) // 2 for size in sizes]
        return sizes[0], sizes[1], max(1, (sizes[2] - 3) // 2 + 1)

    @property
    def bev_size(self) -> int:
        """Channels of the view from above."""
        return self.settings.bev_channels * self.shape[2]

    def forward(self, voxels: Voxels, clouds: int) -> Pyramid:
        """Return the feature maps of `clouds` clouds."""
        tensor, levels = voxels.tensor, []
        for level in self.levels:
            tensor = level(tensor)
            levels.append(tensor)
        dense = self.flatten(tensor).dense((0, 0, 0), self.shape, clouds)
        # [B x C x X x Y x Z] to [B x C Z x X x Y]
        bev = dense.permute(0, 1, 4, 2, 3).reshape(clouds, self.bev_size, *self.shape[:2])
        return Pyramid(tuple(levels), bev)
