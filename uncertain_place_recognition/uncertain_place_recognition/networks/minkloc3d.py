"""MinkLoc3D (Komorowski, WACV 2021) on the suite's sparse convolution."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_common.sparse import InverseConv3d, SparseConv3d, SparseTensor, SubmanifoldConv3d, voxelize
from uncertain_place_recognition.networks.embedding import PlaceNetwork

_SMALLEST = 1e-6  # GeM's eps; as a clamp it acts as a ReLU


@config
class MinkLoc3dConfig:
    """Shape of the network; the defaults are the paper's (1,055,713 parameters)."""

    coordinates: str = setting(
        'cartesian',
        'of the voxels: x y z, or distance, azimuth and height, which MinkLoc3Dv2 offers for '
        'sweeps that see all around',
        choices=('cartesian', 'polar'),
    )
    voxel: float = setting(0.01, 'edge of a voxel, in units of a submap', low=0.001, high=0.5)
    azimuths: int = setting(160, 'polar voxels of a full turn', low=8, high=4096)
    first_kernel: int = setting(5, 'of the first convolution', low=1)
    planes: tuple[int, ...] = setting((32, 64, 64), 'channels of the three stages')
    size: int = setting(256, 'D: numbers of the embedding', low=2)
    power: float = setting(3.0, 'p of generalised mean pooling at the start', low=1.0)
    dropout: float = setting(0.0, 'share dropped before the way up', low=0.0, high=0.95)
    variance: bool = setting(False, 'estimate the variance of the embedding (aleatoric)')
    unit_length: bool = setting(
        False, 'embeddings of length 1; the paper leaves theirs as they are'
    )

    def check(self) -> 'MinkLoc3dConfig':
        """Return this configuration; raises ConfigError when it cannot be built."""
        if len(self.planes) != 3 or self.first_kernel % 2 == 0:
            raise ConfigError(
                f'expected three planes and an odd first kernel, got {self.planes} and '
                f'{self.first_kernel}'
            )
        return self


ORIGINAL = MinkLoc3dConfig()
# Where drives come back the other way, the polar grid learns more from few batches: there a turn
# is a shift, which neither convolution nor pooling minds.
COMPACT = MinkLoc3dConfig(
    coordinates='polar',
    voxel=0.03,
    azimuths=128,
    first_kernel=3,
    planes=(16, 32, 32),
    size=128,
)


class MinkLoc3d(PlaceNetwork):
    """Three strided stages, one step up, generalised mean pooling."""

    def __init__(self, settings: MinkLoc3dConfig = ORIGINAL) -> None:
        super().__init__(settings.check())
        s = settings
        self.first = SubmanifoldConv3d(1, s.planes[0], s.first_kernel)
        self.first_norm = nn.BatchNorm1d(s.planes[0])
        inputs = (s.planes[0], *s.planes[:-1])
        self.stages = nn.ModuleList(
            [_Stage(before, after) for before, after in zip(inputs, s.planes, strict=True)]
        )
        self.top = nn.Linear(s.planes[2], s.size, bias=False)
        self.up = InverseConv3d(s.size, s.size, self.stages[2].down)  # type: ignore[arg-type]
        self.lateral = nn.Linear(s.planes[1], s.size, bias=False)
        self.power = nn.Parameter(torch.tensor([s.power]))

    def prepare(self, points: Tensor) -> tuple[SparseTensor, int]:
        """Return voxels with feature 1, and the number of submaps; their kernel maps get shared."""
        clouds, number = points.shape[:2]
        xyz = points.reshape(-1, 3).float()
        if self.settings.coordinates == 'polar':
            xyz = self._polar(xyz)
        batch = torch.arange(clouds, device=points.device).repeat_interleave(number)
        voxel = (self.settings.voxel,) * 3
        return voxelize(xyz, torch.ones_like(xyz[:, :1]), voxel, batch), clouds

    def _polar(self, xyz: Tensor) -> Tensor:
        """Return distance, azimuth and height; azimuths so large that a voxel's edge divides them.

        Its first voxel and its last are no neighbours: behind the car, two columns miss each other.
        """
        x, y, z = xyz.unbind(1)
        turn = self.settings.azimuths * self.settings.voxel
        azimuth = (torch.atan2(y, x) / (2.0 * math.pi) + 0.5) * turn
        return torch.stack([torch.hypot(x, y), azimuth, z], 1)

    def pool(self, seen: tuple[SparseTensor, int]) -> Tensor:
        """Return pooled features [B x D]."""
        voxels, clouds = seen
        x = voxels.with_features(self.first_norm(self.first(voxels).features).relu())
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        top = levels[2].with_features(self.dropout(self.top(levels[2].features)))
        # No normalisation and no ReLU on the way up, as in the authors' code.
        up = self.up(top, levels[1])
        features = up.features + self.lateral(levels[1].features)
        return generalised_mean(features, levels[1].coordinates[:, 0], clouds, self.power)


class _Stage(nn.Module):
    """Halve the grid, then one residual block (MinkowskiEngine's BasicBlock)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.down = SparseConv3d(inputs, inputs, 2, 2, 0, covered=False)
        self.down_norm = nn.BatchNorm1d(inputs)
        self.first = SubmanifoldConv3d(inputs, outputs)
        self.first_norm = nn.BatchNorm1d(outputs)
        self.second = SubmanifoldConv3d(outputs, outputs)
        self.second_norm = nn.BatchNorm1d(outputs)
        self.skip: Any = nn.Identity()
        if inputs != outputs:
            self.skip = nn.Sequential(
                nn.Linear(inputs, outputs, bias=False), nn.BatchNorm1d(outputs)
            )

    def forward(self, x: SparseTensor) -> SparseTensor:
        x = self.down(x)
        x = x.with_features(self.down_norm(x.features).relu())
        y = x.with_features(self.first_norm(self.first(x).features).relu())
        features = self.second_norm(self.second(y).features) + self.skip(x.features)
        return x.with_features(features.relu())


def generalised_mean(features: Tensor, batch: Tensor, clouds: int, power: Tensor) -> Tensor:
    """Return (mean of x^p)^(1/p) [B x D] over the rows of each cloud (Radenovic et al., PAMI 2019).

    Args:
        features: [N x D].
        batch: [N] the cloud of each row.
        clouds: B.
        power: [1] p.
    """
    raised = features.clamp(min=_SMALLEST) ** power
    sums = raised.new_zeros((clouds, features.shape[1])).index_add(0, batch, raised)
    count = torch.bincount(batch, minlength=clouds).clamp(min=1)
    return (sums / count[:, None]) ** (1.0 / power)
