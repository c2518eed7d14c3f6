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
    side = 2 * displacement + 1
    padded = functional.pad(other, (displacement,) * 4)
    # A row of cells with all rows within reach in one product, then the columns within reach:
    # quicker than a product for each displacement.
    reach = padded.unfold(2, side, 1).permute(0, 2, 1, 4, 3).reshape(batch * height, channels, -1)
    row = (one / channels).permute(0, 2, 3, 1).reshape(batch * height, width, channels)
    index = _within_reach(width, side, one.device)
    found = (row @ reach).gather(2, index.expand(batch * height, -1, -1))
    return found.view(batch, height, width, -1).permute(0, 3, 1, 2)


def _within_reach(width: int, side: int, device: torch.device) -> Tensor:
    """Return the cells [W x side^2] around each of a row, in `side` rows of width + side - 1."""
    down, right = torch.arange(side, device=device), torch.arange(side, device=device)
    shift = down[:, None] * (width + side - 1) + right
    return torch.arange(width, device=device)[:, None] + shift.reshape(1, -1)
