"""PointNetVLAD (Uy and Lee, CVPR 2018)."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.netvlad import NetVlad
from uncertain_place_recognition.networks.embedding import PlaceNetwork


@config
class PointNetVladConfig:
    """Shape of the network; the defaults are the authors' TensorFlow code.

    The PyTorch port that most later work uses has `transform_norm`, `unit_features` and
    `unit_length` off.
    """

    points: int = setting(0, 'points seen of a submap, evenly over it; 0: all', low=0)
    widths: tuple[int, ...] = setting((64, 64, 64, 128, 1024), 'of the five layers on each point')
    transform_widths: tuple[int, ...] = setting((64, 128, 1024, 512, 256), 'of both T-nets')
    transform_norm: bool = setting(True, 'batch normalisation in the T-nets')
    unit_features: bool = setting(True, 'features of length 1 before they are aggregated')
    clusters: int = setting(64, 'K: clusters of NetVLAD', low=2)
    size: int = setting(256, 'D: numbers of the embedding', low=2)
    dropout: float = setting(0.0, 'share of local features dropped', low=0.0, high=0.95)
    variance: bool = setting(False, 'estimate the variance of the embedding (aleatoric)')
    unit_length: bool = setting(True, 'embeddings of length 1')

    def check(self) -> 'PointNetVladConfig':
        """Return this configuration; raises ConfigError when it cannot be built."""
        if len(self.widths) != 5 or len(self.transform_widths) != 5:
            raise ConfigError(
                f'expected five widths and five of the T-nets, got {self.widths} and '
                f'{self.transform_widths}'
            )
        return self


ORIGINAL = PointNetVladConfig()
# 19,779,145 parameters: the shape whose size is published most often.
PORT = PointNetVladConfig(transform_norm=False, unit_features=False, unit_length=False)
COMPACT = PointNetVladConfig(
    points=512,
    widths=(32, 32, 32, 64, 128),
    transform_widths=(32, 64, 128, 64, 32),
    clusters=32,
    size=128,
)


class PointNetVlad(PlaceNetwork):
    """PointNet without its last pooling, then NetVLAD."""

    def __init__(self, settings: PointNetVladConfig = ORIGINAL) -> None:
        super().__init__(settings.check())
        s = settings
        self.turn = _Transform(3, s.transform_widths, s.transform_norm)
        self.bend = _Transform(s.widths[1], s.transform_widths, s.transform_norm)
        widths = (3, *s.widths)
        self.layers = nn.ModuleList([nn.Linear(a, b) for a, b in pairwise(widths)])
        self.norms = nn.ModuleList([nn.BatchNorm1d(width) for width in s.widths])
        self.vlad = NetVlad(s.widths[-1], s.clusters, s.size, unit_length=False)

    def prepare(self, points: Tensor) -> Tensor:
        """Return the points that are seen [B x N x 3]."""
        wanted, number = self.settings.points, points.shape[1]
        if not wanted or number <= wanted:
            return points.float()
        # Submaps come in the order of their cells, so even steps thin them evenly.
        chosen = torch.arange(wanted, device=points.device) * number // wanted
        return points[:, chosen].float()

    def pool(self, seen: Tensor) -> Tensor:
        """Return pooled features [B x D]."""
        x = seen @ self.turn(seen)
        for number in range(2):
            x = self._layer(x, number)
        x = x @ self.bend(x)
        for number in range(2, 5):
            x = self._layer(x, number, last=number == 4)
        if self.settings.unit_features:
            x = functional.normalize(x, dim=2)
        pooled: Tensor = self.vlad(self.dropout(x))
        return pooled

    def _layer(self, x: Tensor, number: int, last: bool = False) -> Tensor:
        y = self.layers[number](x)
        y = self.norms[number](y.reshape(-1, y.shape[2])).view(y.shape)
        return y if last else y.relu()


class _Transform(nn.Module):
    """T-net: a matrix [B x C x C] from all points, near the identity at the start."""

    def __init__(self, channels: int, widths: tuple[int, ...], norm: bool) -> None:
        super().__init__()
        self.channels = channels
        on_points = (channels, *widths[:3])
        self.on_points = nn.ModuleList([_Dense(a, b, norm) for a, b in pairwise(on_points)])
        self.on_whole = nn.ModuleList([_Dense(a, b, norm) for a, b in pairwise(widths[2:])])
        self.matrix = nn.Linear(widths[4], channels * channels)
        nn.init.zeros_(self.matrix.weight)
        with torch.no_grad():
            self.matrix.bias.copy_(torch.eye(channels).flatten())

    def forward(self, x: Tensor) -> Tensor:
        clouds = len(x)
        for layer in self.on_points:
            x = layer(x)
        y = x.amax(1)
        for layer in self.on_whole:
            y = layer(y)
        return torch.as_tensor(self.matrix(y)).view(clouds, self.channels, self.channels)


class _Dense(nn.Module):
    def __init__(self, inputs: int, outputs: int, norm: bool) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs) if norm else None

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.linear(x)
        if self.norm is not None:
            y = self.norm(y.reshape(-1, y.shape[-1])).view(y.shape)
        return y.relu()
