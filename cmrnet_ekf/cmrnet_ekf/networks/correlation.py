"""Compare each cell of one map with the cells around it in another."""

import torch
from torch import Tensor
from torch.nn import functional


def correlate(one: Tensor, other: Tensor, displacement: int) -> Tensor:
    """Return how alike cells are, for every displacement up to a number of cells.

    FlowNet's correlation with kernel 1 and stride 1: the mean over channels of the products.

    Args:
        one, other: [B x C x H x W].
        displacement: d, to each side.

    Returns:
        [B x (2d+1)^2 x H x W], row by row from (-d, -d); beyond the border the other map is 0.
    """
    batch, channels, height, width = one.shape
    padded = functional.pad(other, (displacement,) * 4)
    # All pairs in one product, then those within reach: quicker than a product for each.
    pairs = one.flatten(2).transpose(1, 2) @ padded.flatten(2) / channels
    index = _within_reach(height, width, displacement, one.device)
    found = pairs.gather(2, index.expand(batch, -1, -1))
    return found.transpose(1, 2).reshape(batch, -1, height, width)


def _within_reach(height: int, width: int, displacement: int, device: torch.device) -> Tensor:
    """Return the cells [H W x (2d+1)^2] of the padded map around each cell."""
    side = 2 * displacement + 1
    rows, columns = (
        torch.arange(count, device=device) for count in (max(height, side), width + side - 1)
    )
    cell = rows[:height, None] * len(columns) + columns[:width]
    shift = rows[:side, None] * len(columns) + columns[:side]
    return cell.reshape(-1, 1) + shift.reshape(1, -1)
