"""Say for each cell of the image where the correlation finds it in the map, and how far away.

Not in CMRNet, whose estimator sees how alike cells are and must guess their depth: what a
translation moves in an image depends on it. The LiDAR image knows it.
"""

import torch
from torch import Tensor
from torch.nn import functional

CHANNELS = 8
_LEAST_INVERSE_M = 0.01  # the far end of the map
_LARGEST = 4.0  # of metres moved sideways, over _SCALE
_SCALE_M = 2.0


def cell_flow(
    correlation: Tensor, lidar: Tensor, displacement: int, sharpness: float, focal: float
) -> Tensor:
    """Return what is known of each cell [B x 8 x rows x columns].

    Channels: shift down and to the right (shares of the reach), inverse depth there (1 / 10 m),
    metres that the shift is at that depth down and to the right (2 m), how sure the softmax is,
    how much map lies within reach, and the inverse depth of the cell itself (1 / 10 m).

    Args:
        correlation: [B x (2d+1)^2 x rows x columns]; see `correlate`.
        lidar: [B x H x W] depth in metres, 0 where nothing is seen.
        displacement: d.
        sharpness: factor of the correlation before the softmax over displacements.
        focal: of the images, pixels.
    """
    rows, columns = correlation.shape[2:]
    size = lidar.shape[1] // rows, lidar.shape[2] // columns
    seen = (lidar > 0).float()[:, None]
    inverse = seen / lidar[:, None].clamp(min=0.5)
    share = functional.avg_pool2d(seen, size)
    inverse = functional.avg_pool2d(inverse, size) / share.clamp(min=1e-6)
    near_inverse, near_share = (_within_reach(x, displacement) for x in (inverse, share))
    logits = sharpness * correlation.float()
    # Where the map shows nothing there is nothing to be found.
    weight = functional.softmax(logits.masked_fill(near_share <= 0, -30.0), 1)
    weight = weight * (near_share > 0)
    steps = torch.arange(-displacement, displacement + 1, device=lidar.device).float()
    side = 2 * displacement + 1
    down = torch.einsum('bkrc,k->brc', weight, steps.repeat_interleave(side))
    right = torch.einsum('bkrc,k->brc', weight, steps.repeat(side))
    there = (weight * near_inverse).sum(1)
    metres = 1.0 / (there.clamp(min=_LEAST_INVERSE_M) * focal * _SCALE_M)
    parts = [
        down / displacement,
        right / displacement,
        10.0 * there,
        (down * size[0] * metres).clamp(-_LARGEST, _LARGEST),
        (right * size[1] * metres).clamp(-_LARGEST, _LARGEST),
        weight.amax(1),
        near_share.mean(1),
        10.0 * inverse[:, 0],
    ]
    return torch.stack(parts, 1)


def _within_reach(cells: Tensor, displacement: int) -> Tensor:
    """Return the cells around each cell [B x (2d+1)^2 x rows x columns]; 0 beyond the border."""
    batch, _, rows, columns = cells.shape
    around = functional.unfold(cells, 2 * displacement + 1, padding=displacement)
    return around.view(batch, -1, rows, columns)
