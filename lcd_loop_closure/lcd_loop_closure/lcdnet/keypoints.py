"""Choose keypoints: farthest point sampling."""

import numpy as np
import torch
from torch import Tensor


def farthest_points(xyz: Tensor, count: int, first: int = 0) -> Tensor:
    """Return the indices [count] of points [N x 3], each the farthest from those before it.

    Eldar et al., 1997. A cloud of fewer points gives all of them, then repeats.
    """
    number = len(xyz)
    if number <= count:
        return torch.arange(count, device=xyz.device) % max(number, 1)
    if xyz.device.type == 'cpu':
        import fpsample

        # Its faster samplers begin anywhere: the same cloud would get other keypoints each time.
        chosen = fpsample.fps_sampling(
            np.ascontiguousarray(xyz.detach().numpy(), np.float32), count, start_idx=first
        )
        return torch.from_numpy(chosen.astype(np.int64))
    chosen = torch.empty(count, dtype=torch.long, device=xyz.device)
    nearest = torch.full((number,), torch.inf, device=xyz.device)
    at = torch.tensor(first, device=xyz.device)
    for k in range(count):
        chosen[k] = at
        nearest = torch.minimum(nearest, ((xyz - xyz[at]) ** 2).sum(1))
        at = torch.argmax(nearest)
    return chosen


def above_ground(xyz: Tensor, height_m: float, cell_m: float = 2.0) -> Tensor:
    """Return the mask [N] of points at least so high above the lowest point around them.

    The ground below a point is the lowest point of its own and the eight neighbouring columns, so
    hills do not count as structure.
    """
    if not len(xyz):
        return torch.zeros(0, dtype=torch.bool, device=xyz.device)
    cell = torch.floor(xyz[:, :2] / cell_m).long()
    cell = cell - cell.amin(0) + 1
    wide, long = (cell.amax(0) + 2).tolist()
    flat = cell[:, 0] * long + cell[:, 1]
    lowest = torch.full((wide * long,), torch.inf, device=xyz.device, dtype=xyz.dtype)
    lowest = lowest.scatter_reduce(0, flat, xyz[:, 2], 'amin').view(1, 1, wide, long)
    around = -torch.nn.functional.max_pool2d(-lowest, 3, stride=1, padding=1)
    return xyz[:, 2] - around.view(-1)[flat] >= height_m
