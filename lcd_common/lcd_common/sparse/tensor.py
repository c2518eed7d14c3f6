"""Features on the occupied voxels of a grid."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lcd_common.errors import DataError

# A key holds the cloud's number and three coordinates of 16 bits each, in their order.
_BITS = 16
_OFFSET = 1 << (_BITS - 1)
_LARGEST = _OFFSET - 256  # room for a kernel's reach


@dataclass(frozen=True)
class SparseTensor:
    """Features of voxels, sorted by cloud and coordinates, each voxel once.

    Attributes:
        coordinates: [N x 4] int64: cloud in the batch, x, y, z; in steps of this level's grid.
        features: [N x C].
        keys: [N] int64, increasing: the coordinates as one number.
        maps: kernel maps of this level, shared by all layers (and networks) that ask for the same.
    """

    coordinates: Tensor
    features: Tensor
    keys: Tensor
    maps: dict[tuple[object, ...], Any] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.coordinates)

    def with_features(self, features: Tensor) -> 'SparseTensor':
        """Return other features on the same voxels; maps stay shared."""
        return SparseTensor(self.coordinates, features, self.keys, self.maps)

    def clouds(self) -> int:
        """Return how many clouds are in the batch."""
        return int(self.coordinates[-1, 0]) + 1 if len(self) else 0

    def dense(self, low: Sequence[int], shape: Sequence[int], clouds: int | None = None) -> Tensor:
        """Return a grid [B x C x X x Y x Z] that starts at voxel `low`; zero where there is none.

        Voxels outside are left out.
        """
        at = self.coordinates[:, 1:] - torch.as_tensor(list(low), device=self.keys.device)
        size = torch.as_tensor(list(shape), device=self.keys.device)
        inside = ((at >= 0) & (at < size)).all(1)
        batch, (x, y, z) = self.coordinates[inside, 0], at[inside].unbind(1)
        number = self.clouds() if clouds is None else clouds
        grid = self.features.new_zeros((number, *shape, self.features.shape[1]))
        grid[batch, x, y, z] = self.features[inside]
        return grid.permute(0, 4, 1, 2, 3)


def pack(coordinates: Tensor) -> Tensor:
    """Return one number [N] int64 for each row of [N x 4]; its order is that of the rows."""
    shifted = coordinates[:, 1:] + _OFFSET
    key = coordinates[:, 0]
    for axis in range(3):
        key = (key << _BITS) + shifted[:, axis]
    return key


def unpack(keys: Tensor) -> Tensor:
    """Return the coordinates [N x 4] of keys [N]."""
    mask = (1 << _BITS) - 1
    z, y, x = (((keys >> (_BITS * axis)) & mask) - _OFFSET for axis in range(3))
    return torch.stack([keys >> (3 * _BITS), x, y, z], 1)


def sorted_tensor(coordinates: Tensor, features: Tensor) -> SparseTensor:
    """Return a tensor on distinct voxels in any order.

    Raises:
        DataError: shapes do not fit, a coordinate is too large, or a voxel is there twice.
    """
    if coordinates.ndim != 2 or coordinates.shape[1] != 4 or len(coordinates) != len(features):
        raise DataError(
            f'expected voxels [N x 4] (cloud x y z) with N features, got the shapes '
            f'{tuple(coordinates.shape)} and {tuple(features.shape)}'
        )
    if len(coordinates) and int(coordinates[:, 1:].abs().max()) > _LARGEST:
        raise DataError(
            f'voxel coordinates must lie within +-{_LARGEST}; use larger voxels or crop the cloud'
        )
    keys, order = torch.sort(pack(coordinates.long()))
    if len(keys) > 1 and bool((keys[1:] == keys[:-1]).any()):
        raise DataError('a voxel is there twice; merge its points first (voxelize does)')
    return SparseTensor(coordinates.long()[order], features[order], keys)


def voxelize(
    xyz: Tensor, features: Tensor, voxel_size: Sequence[float], batch: Tensor | None = None
) -> SparseTensor:
    """Return the mean features of the points in each voxel (mean VFE).

    Args:
        xyz: [N x 3] metres.
        features: [N x C] of the points.
        voxel_size: of x, y and z, metres; voxel (0, 0, 0) begins at the origin.
        batch: [N] int64, the cloud that each point belongs to; None is one cloud.
    """
    size = torch.as_tensor(list(voxel_size), dtype=xyz.dtype, device=xyz.device)
    cells = torch.floor(xyz / size).long()
    cloud = torch.zeros(len(xyz), dtype=torch.long, device=xyz.device) if batch is None else batch
    if len(cells) and int(cells.abs().max()) > _LARGEST:
        raise DataError(
            f'voxel coordinates must lie within +-{_LARGEST}; use larger voxels or crop the cloud'
        )
    keys, voxel, count = torch.unique(
        pack(torch.cat([cloud[:, None], cells], 1)), return_inverse=True, return_counts=True
    )
    sums = features.new_zeros((len(keys), features.shape[1])).index_add(0, voxel, features)
    return SparseTensor(unpack(keys), sums / count[:, None].to(sums.dtype), keys)
