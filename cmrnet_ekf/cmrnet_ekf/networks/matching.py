"""Teach the correlation where cells of the map lie in the image; not in the thesis.

The poses of a training tell which pixels show the same surface. From them the correlation learns
in minutes what it takes days to find out by the errors of poses alone.
"""

import torch
from torch import Tensor

from cmrnet_ekf.euler import rotation_tensor

_NEAREST_M = 0.5


def cell_matches(
    lidar: Tensor, target: Tensor, camera: Tensor, grid: tuple[int, int], displacement: int
) -> Tensor:
    """Count the map's pixels that lie in each image cell, by where the guess sees them.

    Args:
        lidar: [B x H x W] depth in metres as the guess sees it, 0 where nothing is seen.
        target: [B x 6] components of T_guess_camera.
        camera: [B x 4] fx fy cx cy of the images, pixels.
        grid: rows and columns of the cells, which cover the image evenly.
        displacement: d, cells to each side that the correlation looks at.

    Returns:
        [B x (2d+1)^2 x rows x columns], in the correlation's order: how many pixels of the map,
        seen in the cell that is so far away, belong in this one.
    """
    height, width = lidar.shape[1:]
    rows, columns = grid
    sample, v, u = torch.nonzero(lidar > 0, as_tuple=True)
    z = lidar[sample, v, u]
    fx, fy, cx, cy = camera[sample].unbind(1)
    # In the vehicle's axes: forward, left, up.
    p_guess = torch.stack([z, -(u - cx) / fx * z, -(v - cy) / fy * z], 1)
    R, t = rotation_tensor(target[:, 3:]), target[:, :3]
    p_camera = torch.einsum('nji,nj->ni', R[sample], p_guess - t[sample])
    ahead, left, up = p_camera.unbind(1)
    depth = ahead.clamp(min=_NEAREST_M)
    row = torch.floor((cy - fy * up / depth + 0.5) * (rows / height)).long()
    column = torch.floor((cx - fx * left / depth + 0.5) * (columns / width)).long()
    down = torch.div(v * rows, height, rounding_mode='floor') - row + displacement
    right = torch.div(u * columns, width, rounding_mode='floor') - column + displacement
    side = 2 * displacement + 1
    kept = (ahead > _NEAREST_M) & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    kept &= (down >= 0) & (down < side) & (right >= 0) & (right < side)
    cell = ((sample * side + down) * side + right) * rows + row
    at = (cell * columns + column)[kept]
    counts = torch.bincount(at, minlength=len(lidar) * side * side * rows * columns)
    return counts.view(len(lidar), side * side, rows, columns).to(lidar.dtype)


def matching_loss(correlation: Tensor, matches: Tensor, sharpness: float) -> Tensor:
    """Return the mean cross-entropy of displacements over the cells that show the map.

    Args:
        correlation: [B x (2d+1)^2 x rows x columns].
        matches: counts of the same shape; see `cell_matches`.
        sharpness: factor of the correlation before the softmax over displacements.
    """
    pixels = matches.sum(1, keepdim=True)
    share = matches / pixels.clamp(min=1.0)
    entropy = -(share * (sharpness * correlation.float()).log_softmax(1)).sum(1)
    seen = (pixels[:, 0] > 0).float()
    return (entropy * seen).sum() / seen.sum().clamp(min=1.0)
