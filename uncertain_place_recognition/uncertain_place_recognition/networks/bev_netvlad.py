"""A convolutional network on the view from above, then NetVLAD.

The row "ResNet34 + NetVLAD" of BEVPlace (Luo et al., ICCV 2023): on places that it was not trained
on a plain image network beats networks on points, and needs no sparse convolution.
"""

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.netvlad import NetVlad
from uncertain_place_recognition.networks.embedding import PlaceNetwork


@config
class BevNetVladConfig:
    """Shape of the network; the defaults are a ResNet-34 up to its third stage."""

    view: str = setting(
        'cartesian',
        'of the image: x and y, or distance and azimuth, where a turn is a shift',
        choices=('cartesian', 'polar'),
    )
    rows: int = setting(256, 'pixels along x, or along the distance', low=8)
    columns: int = setting(256, 'pixels along y, or round the azimuth', low=8)
    slabs: tuple[float, ...] = setting(
        (), 'heights between the channels of the image, in units of a submap'
    )
    first_kernel: int = setting(7, 'of the first convolution, which has the stride 2', low=1)
    widths: tuple[int, ...] = setting((64, 128, 256), 'of the stages; each but the first halves')
    blocks: tuple[int, ...] = setting((3, 4, 6), 'residual blocks of the stages')
    clusters: int = setting(64, 'K: clusters of NetVLAD', low=2)
    size: int = setting(256, 'D: numbers of the embedding', low=2)
    dropout: float = setting(0.0, 'share of local features dropped', low=0.0, high=0.95)
    variance: bool = setting(False, 'estimate the variance of the embedding (aleatoric)')
    unit_length: bool = setting(True, 'embeddings of length 1')

    def check(self) -> 'BevNetVladConfig':
        """Return this configuration; raises ConfigError when it cannot be built."""
        if not self.widths or len(self.widths) != len(self.blocks) or self.first_kernel % 2 == 0:
            raise ConfigError(
                f'expected a number of blocks for each width and an odd first kernel, got '
                f'{self.widths}, {self.blocks} and {self.first_kernel}'
            )
        if any(low >= high for low, high in pairwise(self.slabs)):
            raise ConfigError(f'slabs must rise, got {self.slabs}')
        return self


ORIGINAL = BevNetVladConfig()
# Where drives come back the other way, the polar view learns much more from few batches: there a
# turn is a shift, which neither convolution nor NetVLAD minds.
COMPACT = BevNetVladConfig(
    view='polar',
    rows=48,
    columns=160,
    slabs=(0.04, 0.1),
    first_kernel=5,
    widths=(16, 32, 64),
    blocks=(1, 1, 1),
    clusters=32,
    size=128,
)


class BevNetVlad(PlaceNetwork):
    """Residual stages on an image of densities, one channel for each slab of height."""

    def __init__(self, settings: BevNetVladConfig = ORIGINAL) -> None:
        super().__init__(settings.check())
        s = settings
        round_about = s.view == 'polar'
        channels = len(s.slabs) + 1
        self.first = _Conv(channels, s.widths[0], s.first_kernel, 2, round_about)
        self.first_norm = nn.BatchNorm2d(s.widths[0])
        stages: list[nn.Module] = []
        before = s.widths[0]
        for number, (width, count) in enumerate(zip(s.widths, s.blocks, strict=True)):
            for block in range(count):
                stride = 2 if number and not block else 1
                stages.append(_Block(before, width, stride, round_about))
                before = width
        self.stages = nn.Sequential(*stages)
        self.vlad = NetVlad(before, s.clusters, s.size, unit_length=False)

    def prepare(self, points: Tensor) -> Tensor:
        """Return images [B x C x rows x columns]: how many points stand on a pixel, compressed."""
        s = self.settings
        x, y, z = points.float().unbind(2)
        if s.view == 'polar':
            along = torch.hypot(x, y) * s.rows
            across = (torch.atan2(y, x) / (2.0 * math.pi) + 0.5) * s.columns
            across = across % s.columns
        else:
            along, across = (x + 1.0) * 0.5 * s.rows, (y + 1.0) * 0.5 * s.columns
        row, column = along.floor().long(), across.floor().long()
        inside = (row >= 0) & (row < s.rows) & (column >= 0) & (column < s.columns)
        edges = torch.tensor(s.slabs, device=z.device, dtype=z.dtype)
        slab = torch.bucketize(z.contiguous(), edges)
        clouds, channels = len(points), len(s.slabs) + 1
        cloud = torch.arange(clouds, device=z.device)[:, None].expand_as(row)
        flat = ((cloud * channels + slab) * s.rows + row) * s.columns + column
        count = torch.bincount(flat[inside], minlength=clouds * channels * s.rows * s.columns)
        return count.float().log1p().view(clouds, channels, s.rows, s.columns)

    def pool(self, seen: Tensor) -> Tensor:
        """Return pooled features [B x D]."""
        x = self.stages(self.first_norm(self.first(seen)).relu())
        features = functional.normalize(x.flatten(2).transpose(1, 2), dim=2)
        pooled: Tensor = self.vlad(self.dropout(features))
        return pooled


class _Conv(nn.Conv2d):
    """Convolve; in the polar view the last column's neighbour is the first."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int, round_about: bool
    ) -> None:
        super().__init__(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.round_about = round_about

    def forward(self, x: Tensor) -> Tensor:
        if not self.round_about:
            return super().forward(x)
        pad = self.kernel_size[0] // 2
        x = functional.pad(x, (pad, pad, 0, 0), mode='circular') if pad else x
        return functional.conv2d(x, self.weight, None, self.stride, (pad, 0))


class _Block(nn.Module):
    """ResNet's basic block (He et al., CVPR 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int, round_about: bool) -> None:
        super().__init__()
        self.first = _Conv(inputs, outputs, 3, stride, round_about)
        self.first_norm = nn.BatchNorm2d(outputs)
        self.second = _Conv(outputs, outputs, 3, 1, round_about)
        self.second_norm = nn.BatchNorm2d(outputs)
        self.skip: Any = nn.Identity()
        if stride != 1 or inputs != outputs:
            self.skip = nn.Sequential(
                _Conv(inputs, outputs, 1, stride, round_about), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = self.first_norm(self.first(x)).relu()
        return (self.second_norm(self.second(y)) + self.skip(x)).relu()
