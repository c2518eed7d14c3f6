"""Layers of sparse convolution: gather, one matrix product a tap, one scattered sum."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from lcd_common.errors import ConfigError
from lcd_common.sparse.kernel_map import KernelMap, strided_map, submanifold_map
from lcd_common.sparse.tensor import SparseTensor

Size = int | Sequence[int]


def convolve(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Return the output features [M x C_out] of features [N x C_in] by weights [K x C_in x C_out].

    One sum over all taps at the end is two to six times as fast as one for each.
    """
    on_cpu = features.device.type == 'cpu' and not torch.is_autocast_enabled('cpu')
    if on_cpu and not torch.is_grad_enabled():
        return _tap_by_tap(features, weight, kernel_map)
    # index_select: its gradient is one sum, that of an index by brackets is slow
    gathered = features.index_select(0, kernel_map.source)
    parts = [
        part @ weight[tap] for tap, part in enumerate(gathered.split(kernel_map.pairs)) if len(part)
    ]
    if not parts:
        return gathered.new_zeros((len(kernel_map.keys), weight.shape[2]))
    every = torch.cat(parts)  # in the precision that autocast chose
    out = every.new_zeros((len(kernel_map.keys), weight.shape[2]))
    return out.index_add(0, kernel_map.target, every)


def _tap_by_tap(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    """Return the same without gradients: what one tap gathers stays in the cache."""
    out = features.new_zeros((len(kernel_map.keys), weight.shape[2]))
    most = max(kernel_map.pairs, default=0)
    gathered = features.new_empty((most, features.shape[1]))
    products = features.new_empty((most, weight.shape[2]))
    begin = 0
    for tap, pairs in enumerate(kernel_map.pairs):
        end = begin + pairs
        if pairs:
            source, target = kernel_map.source[begin:end], kernel_map.target[begin:end]
            torch.index_select(features, 0, source, out=gathered[:pairs])
            torch.mm(gathered[:pairs], weight[tap], out=products[:pairs])
            out.index_add_(0, target, products[:pairs])
        begin = end
    return out


class _Convolution(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: Size, bias: bool) -> None:
        super().__init__()
        self.kernel = _triple(kernel)
        taps = math.prod(self.kernel)
        self.weight = nn.Parameter(torch.empty(taps, inputs, outputs))
        self.bias = nn.Parameter(torch.zeros(outputs)) if bias else None
        # As torch's own layers: uniform by the number of inputs that a voxel may have.
        bound = 1.0 / math.sqrt(taps * inputs)
        nn.init.uniform_(self.weight, -bound, bound)

    def _apply_map(
        self, tensor: SparseTensor, kernel_map: KernelMap, scale: Tensor | None = None
    ) -> Tensor:
        weight = self.weight if scale is None else self.weight * scale
        out = convolve(tensor.features, weight, kernel_map)
        return out if self.bias is None else out + self.bias

    def extra_repr(self) -> str:
        """Show the sizes when the layer is printed."""
        return f'{self.weight.shape[1]}, {self.weight.shape[2]}, kernel={self.kernel}'


class SubmanifoldConv3d(_Convolution):
    """Convolve on the voxels that there are; no new ones come in (Graham et al., CVPR 2018)."""

    def __init__(self, inputs: int, outputs: int, kernel: Size = 3, *, bias: bool = False) -> None:
        super().__init__(inputs, outputs, kernel, bias)

    def forward(self, tensor: SparseTensor, scale: Tensor | None = None) -> SparseTensor:
        """Return new features on the same voxels, each output channel times `scale` [C_out]."""
        name = ('submanifold', self.kernel)
        if name not in tensor.maps:
            tensor.maps[name] = submanifold_map(tensor, self.kernel)
        kernel_map = tensor.maps[name]
        return tensor.with_features(self._apply_map(tensor, kernel_map, scale))


class SparseConv3d(_Convolution):
    """Convolve onto a coarser grid."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: Size = 3,
        stride: Size = 2,
        padding: Size | None = None,
        *,
        covered: bool = True,
        bias: bool = False,
    ) -> None:
        """Make a layer.

        Args:
            inputs, outputs: channels.
            kernel, stride, padding: along x, y, z; padding None is (kernel - 1) // 2.
            covered: as of `strided_map`.
            bias: add one.
        """
        super().__init__(inputs, outputs, kernel, bias)
        self.stride, self.covered = _triple(stride), covered
        centred = tuple((size - 1) // 2 for size in self.kernel)
        self.padding = centred if padding is None else _triple(padding)

    def forward(self, tensor: SparseTensor, scale: Tensor | None = None) -> SparseTensor:
        """Return features on the coarser grid, each output channel times `scale` [C_out]."""
        name = ('strided', self.kernel, self.stride, self.padding, self.covered)
        if name not in tensor.maps:
            kernel_map = strided_map(
                tensor, self.kernel, self.stride, self.padding, covered=self.covered
            )
            # The coarser level's own maps are shared as well.
            tensor.maps[name] = kernel_map, {}
        kernel_map, maps = tensor.maps[name]
        features = self._apply_map(tensor, kernel_map, scale)
        return SparseTensor(kernel_map.coordinates, features, kernel_map.keys, maps)


class InverseConv3d(_Convolution):
    """Bring features back from the grid of a `SparseConv3d` onto the voxels it came from."""

    def __init__(
        self, inputs: int, outputs: int, down: SparseConv3d, *, bias: bool = False
    ) -> None:
        """Make the layer that goes `down`'s way back; `down` must have run on the finer tensor."""
        super().__init__(inputs, outputs, down.kernel, bias)
        self._name = ('strided', down.kernel, down.stride, down.padding, down.covered)

    def forward(self, tensor: SparseTensor, finer: SparseTensor) -> SparseTensor:
        """Return features on the voxels of `finer`.

        Raises:
            ConfigError: the strided layer has not run on `finer`.
        """
        if self._name not in finer.maps:
            raise ConfigError('an InverseConv3d needs the tensor that its SparseConv3d has seen')
        kernel_map, _ = finer.maps[self._name]
        return finer.with_features(self._apply_map(tensor, kernel_map.inverse(finer)))


def _triple(size: Size) -> tuple[int, ...]:
    sizes = (size,) * 3 if isinstance(size, int) else tuple(size)
    if len(sizes) != 3:
        raise ConfigError(f'expected one size or three (x, y, z), got {size}')
    return sizes
