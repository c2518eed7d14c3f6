"""Find the nearest of a million descriptors: all of them with eight bits, the best in full."""

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcd_common.errors import DataError

# Half the distance of neighbouring bfloat16 numbers, relative.
_BFLOAT16 = 2.0**-8
_BLOCK = 4096
# torch's kernel takes whole blocks alone; smaller ones end in a segmentation fault.
_WHOLE = 64


class CompactSearch:
    """Exhaustive search over descriptors of unit length by L2 distance; the answer is exact.

    A query has to read all of the memory that holds the rows, and that is what takes its time: rows
    are kept with eight bits a number for the first look. How far that look may be off is known,
    because the rounding error of every row is: all rows that may still be among the nearest are
    compared again in single precision.
    """

    def __init__(self, length: int, capacity: int = 1024) -> None:
        """Start empty, for descriptors of `length` numbers; it grows beyond `capacity`."""
        self.length = length
        capacity = _padded(max(capacity, 1))
        self._steps = torch.zeros((capacity, length), dtype=torch.int8)
        self._scale = torch.zeros(capacity, dtype=torch.bfloat16)
        self._full = np.empty((capacity, length), np.float32)
        self._size, self._rounding = 0, 0.0

    def __len__(self) -> int:
        return self._size

    @property
    def nbytes(self) -> int:
        """Memory of the descriptors held, bytes."""
        return self._size * (5 * self.length + 2)

    def add(self, descriptors: NDArray[np.floating]) -> None:
        """Add descriptors [N x length] of unit length; they are numbered in the order they come.

        Raises:
            DataError: they have another length, or not unit length.
        """
        rows = np.atleast_2d(np.asarray(descriptors, np.float32))
        if rows.shape[1] != self.length:
            raise DataError(
                f'expected descriptors of {self.length} numbers, got {rows.shape[1]}; were they '
                'made by another network?'
            )
        away = np.abs(np.linalg.norm(rows, axis=1) - 1.0)
        if len(rows) and not np.all(away < 1e-3):
            raise DataError(
                f'expected descriptors of unit length, got one off by {float(away.max()):g}'
            )
        first, self._size = self._size, self._size + len(rows)
        self._grow(self._size)
        whole = torch.from_numpy(np.array(rows))
        # Rounded up a little, so that the largest number fits in 127 steps of a bfloat16.
        scale = (whole.abs().amax(1) * (1.01 / 127.0)).to(torch.bfloat16)
        steps = torch.round(whole / scale.float()[:, None])
        self._full[first : self._size] = rows
        self._steps[first : self._size] = steps.to(torch.int8)
        self._scale[first : self._size] = scale
        if len(rows):
            error = torch.linalg.vector_norm(whole - steps * scale.float()[:, None], dim=1)
            self._rounding = max(self._rounding, float(error.max()))

    @torch.inference_mode()
    def nearest(
        self, descriptor: NDArray[np.floating], count: int = 1
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return numbers [K] and L2 distances [K] of the nearest, nearest first.

        Args:
            descriptor: [length], of unit length.
            count: how many; fewer where fewer are held.
        """
        query = np.array(descriptor, np.float32).ravel()
        if query.size != self.length:
            raise DataError(f'expected a descriptor of {self.length} numbers, got {query.size}')
        if not self._size or count < 1:
            return np.empty(0, np.intp), np.empty(0, np.float32)
        count = min(count, self._size)
        whole = torch.from_numpy(query)
        half = whole.to(torch.bfloat16)
        held = _padded(self._size)
        cosine = _cosines(half, self._steps[:held], self._scale[:held])[: self._size]
        best = torch.topk(cosine, count).values if count > 1 else cosine.amax()[None]
        # Rows are off by their rounding, the query by its own, the result by that of bfloat16.
        off = float(torch.linalg.vector_norm(whole - half.float()))
        bound = self._rounding + 1.05 * off + _BFLOAT16 * 1.05
        chosen = torch.nonzero(cosine >= float(best[-1]) - 2.0 * bound).ravel().numpy()
        distance = np.linalg.norm(self._full[chosen] - query, axis=1)
        order = np.lexsort((chosen, distance))[:count]
        return chosen[order].astype(np.intp), distance[order]

    def search(
        self, row: NDArray[np.float32], count: int
    ) -> tuple[NDArray[np.intp], NDArray[np.float32], None]:
        """Return what `nearest` does; these descriptors hold no yaw."""
        return *self.nearest(row, count), None

    def keep(self, numbers: NDArray[np.intp]) -> None:
        """Forget all other rows."""
        rows = self._full[numbers]
        self._size, self._rounding = 0, 0.0
        self.add(rows)

    def _grow(self, needed: int) -> None:
        held = len(self._full)
        if needed <= held:
            return
        more = _padded(max(needed, 2 * held)) - held
        self._full = np.concatenate([self._full, np.empty((more, self.length), np.float32)])
        self._steps = torch.cat([self._steps, self._steps.new_zeros((more, self.length))])
        self._scale = torch.cat([self._scale, self._scale.new_zeros(more)])


def _padded(number: int) -> int:
    return -(-number // _WHOLE) * _WHOLE


def _cosines(query: Tensor, steps: Tensor, scale: Tensor) -> Tensor:
    """Return the products [N] of a query [L] bfloat16 with rows `steps` [N x L] times `scale`."""
    if steps.shape[0] % _WHOLE == 0 and steps.shape[1] % _WHOLE == 0 and _has_kernel():
        return torch._weight_int8pack_mm(query[None], steps, scale)[0].float()  # noqa: SLF001
    return _cosines_in_blocks(query, steps, scale)


def _cosines_in_blocks(query: Tensor, steps: Tensor, scale: Tensor) -> Tensor:
    out, whole = torch.empty(len(steps)), query.float()
    for start in range(0, len(steps), _BLOCK):
        part = slice(start, start + _BLOCK)
        out[part] = torch.mv(steps[part].float(), whole) * scale[part].float()
    return out


@cache
def _has_kernel() -> bool:
    """Tell whether torch's own kernel for such rows is there and computes what it should.

    It belongs to torch's inner workings (made for language models) and is five times as fast.
    """
    if not hasattr(torch, '_weight_int8pack_mm'):
        return False
    generator = torch.Generator().manual_seed(0)
    steps = torch.randint(-127, 128, (192, 128), dtype=torch.int8, generator=generator)
    query = (0.1 * torch.randn(128, generator=generator)).to(torch.bfloat16)
    scale = torch.full((192,), 0.0017, dtype=torch.bfloat16)
    try:
        fast = torch._weight_int8pack_mm(query[None], steps, scale)[0].float()  # noqa: SLF001
    except RuntimeError:
        return False
    return bool(torch.allclose(fast, _cosines_in_blocks(query, steps, scale), rtol=5e-3, atol=1e-5))
