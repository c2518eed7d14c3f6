"""Find, for each tap of a kernel, which input voxel meets which output voxel."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from lcd_common.errors import ConfigError
from lcd_common.sparse.tensor import SparseTensor, pack, unpack


@dataclass(frozen=True)
class KernelMap:
    """Pairs of input and output rows, tap by tap.

    Attributes:
        source, target: [P] rows of the input and of the output.
        pairs: how many of them belong to each tap of the kernel, in its order (x slowest).
        keys: [M] of the output's voxels.
        coordinates: [M x 4] of the output's voxels.
    """

    source: Tensor
    target: Tensor
    pairs: tuple[int, ...]
    keys: Tensor
    coordinates: Tensor

    def inverse(self, to: SparseTensor) -> 'KernelMap':
        """Return the way back, onto the voxels that this map came from."""
        return KernelMap(self.target, self.source, self.pairs, to.keys, to.coordinates)


def taps(kernel: Sequence[int]) -> Tensor:
    """Return the taps [K x 3] of a kernel, counted from its corner, x slowest."""
    return torch.tensor(list(product(*(range(size) for size in kernel))))


def submanifold_map(tensor: SparseTensor, kernel: Sequence[int]) -> KernelMap:
    """Map a tensor onto its own voxels: out(p) = sum over taps o of W(o) in(p + o - centre).

    Only half of the taps are searched: the tap opposite has the same pairs the other way round.

    Raises:
        ConfigError: a size of the kernel is even.
    """
    if any(size % 2 == 0 for size in kernel):
        raise ConfigError(f'a submanifold kernel has odd sizes, got {tuple(kernel)}')
    all_taps = taps(kernel) - torch.tensor([size // 2 for size in kernel])
    number, keys = len(all_taps), tensor.keys
    half = number // 2
    zero = torch.zeros((half, 1), dtype=torch.long)
    # Packed offsets add up as the coordinates do; the zero's own packing is taken off again.
    origin = pack(torch.zeros((1, 4), dtype=torch.long))
    shift = (pack(torch.cat([zero, all_taps[:half]], 1)) - origin).to(keys.device)
    wanted = keys + shift[:, None]
    at = torch.searchsorted(keys, wanted.reshape(-1)).clamp(max=max(len(keys) - 1, 0))
    at = at.view(half, len(keys))
    tap, row = torch.nonzero(keys[at] == wanted, as_tuple=True)
    found = at[tap, row]
    counts = torch.bincount(tap, minlength=half).tolist()
    every = torch.arange(len(keys), device=keys.device)
    sources, targets = list(found.split(counts)), list(row.split(counts))
    return KernelMap(
        torch.cat([*sources, every, *targets[::-1]]),
        torch.cat([*targets, every, *sources[::-1]]),
        (*counts, len(keys), *counts[::-1]),
        keys,
        tensor.coordinates,
    )


def strided_map(
    tensor: SparseTensor,
    kernel: Sequence[int],
    stride: Sequence[int],
    padding: Sequence[int],
    *,
    covered: bool,
) -> KernelMap:
    """Map a tensor onto a coarser grid: out(q) = sum over taps o: W(o) in(q stride - padding + o).

    Args:
        tensor: the input.
        kernel, stride, padding: along x, y, z.
        covered: outputs are all voxels that any tap reaches (spconv); else those whose own cell is
            occupied, q = floor(p / stride) (MinkowskiEngine).
    """
    device = tensor.keys.device
    steps = torch.tensor(list(stride), device=device)
    offset = taps(kernel).to(device) - torch.tensor(list(padding), device=device)
    # p - offset is a multiple of the stride when both leave the same remainders.
    place = torch.tensor([stride[1] * stride[2], stride[2], 1], device=device)
    left_over = ((tensor.coordinates[:, 1:] % steps) * place).sum(1)
    fits = left_over == ((offset % steps) * place).sum(1)[:, None]
    tap, source = torch.nonzero(fits, as_tuple=True)
    position = tensor.coordinates[source, 1:] - offset[tap]  # q * stride
    q = torch.div(position, steps, rounding_mode='floor')
    reached = pack(torch.cat([tensor.coordinates[source, :1], q], 1))
    if covered:
        keys, target = torch.unique(reached, return_inverse=True)
    else:
        cell = torch.div(tensor.coordinates[:, 1:], steps, rounding_mode='floor')
        keys = torch.unique(pack(torch.cat([tensor.coordinates[:, :1], cell], 1)))
        target = torch.searchsorted(keys, reached).clamp(max=max(len(keys) - 1, 0))
        there = keys[target] == reached
        tap, source, target = tap[there], source[there], target[there]
    counts = torch.bincount(tap, minlength=len(offset)).tolist()
    return KernelMap(source, target, tuple(counts), keys, unpack(keys))
