"""Turn clouds into the voxels that the network sees."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lcd_common.sparse import SparseTensor, voxelize
from lcd_loop_closure.lcdnet.config import LcdnetConfig


@dataclass(frozen=True)
class Clouds:
    """Clouds of a batch, point after point.

    Attributes:
        xyz: [M x 3] float32, base frame, metres.
        intensity: [M] float32, 0..1; zero where the sensor gives none.
        batch: [M] int64, which cloud a point belongs to, increasing.
        size: number of clouds.
    """

    xyz: Tensor
    intensity: Tensor
    batch: Tensor
    size: int

    @classmethod
    def of(
        cls, xyz: Sequence[Tensor], intensity: Sequence[Tensor | None] | None = None
    ) -> 'Clouds':
        """Join clouds [M_i x 3] with their intensities [M_i]; None stands for no intensity."""
        given = intensity or [None] * len(xyz)
        values = [
            torch.zeros(len(points), device=points.device) if one is None else one
            for points, one in zip(xyz, given, strict=True)
        ]
        numbers = torch.tensor([len(points) for points in xyz])
        batch = torch.repeat_interleave(torch.arange(len(xyz)), numbers).to(xyz[0].device)
        return cls(torch.cat(list(xyz)).float(), torch.cat(values).float(), batch, len(xyz))


@dataclass(frozen=True)
class Voxels:
    """Occupied voxels of a batch.

    Attributes:
        tensor: features of the finest level; voxel (0, 0, 0) is the corner of the grid.
        xyz: [V x 3] mean of the points in each, metres.
        left_out: voxels beyond the cap, over all clouds.
    """

    tensor: SparseTensor
    xyz: Tensor
    left_out: int


def see(clouds: Clouds, settings: LcdnetConfig) -> Voxels:
    """Return the voxels of clouds with mean features (mean VFE of PV-RCNN)."""
    s = settings
    low = clouds.xyz.new_tensor([-s.reach, -s.reach, s.z_low])
    high = clouds.xyz.new_tensor([s.reach, s.reach, s.z_high])
    inside = ((clouds.xyz >= low) & (clouds.xyz < high)).all(1)
    xyz, batch = clouds.xyz[inside], clouds.batch[inside]
    intensity = clouds.intensity[inside] if s.use_intensity else torch.zeros_like(xyz[:, 0])
    points = torch.cat([xyz, intensity[:, None]], 1)
    tensor = voxelize(xyz - low, points, (s.voxel,) * 3, batch)
    tensor, left_out = _capped(tensor, s.max_voxels)
    mean = tensor.features[:, :3]
    if not s.relative_input:
        return Voxels(tensor, mean, left_out)
    corner = tensor.coordinates[:, 1:] * s.voxel + low
    # Of the order of one, as batch normalisation has no word in the first convolution's inputs.
    within = (mean - corner) / s.voxel - 0.5
    features = torch.cat(
        [torch.ones_like(within[:, :1]), within, 0.2 * mean[:, 2:], tensor.features[:, 3:]], 1
    )
    return Voxels(tensor.with_features(features), mean, left_out)


def input_channels(settings: LcdnetConfig) -> int:
    """Return how many features a voxel has."""
    return 6 if settings.relative_input else 4


def _capped(tensor: SparseTensor, most: int) -> tuple[SparseTensor, int]:
    """Leave out voxels of clouds that have more than `most`, evenly over the sorted ones."""
    counts = torch.bincount(tensor.coordinates[:, 0]) if len(tensor) else torch.zeros(0)
    if not len(counts) or int(counts.max()) <= most:
        return tensor, 0
    first = torch.cumsum(counts, 0) - counts
    rank = torch.arange(len(tensor), device=counts.device) - first[tensor.coordinates[:, 0]]
    total = counts[tensor.coordinates[:, 0]]
    # The k-th of n stays when k m / n passes a whole number: m of them, evenly spread.
    keep = (rank * most) // total != ((rank + 1) * most) // total
    keep |= total <= most
    left = int((~keep).sum())
    return SparseTensor(tensor.coordinates[keep], tensor.features[keep], tensor.keys[keep]), left
