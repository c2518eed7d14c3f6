"""Choose keypoints: farthest point sampling."""

import numpy as np
import torch
from torch import Tensor


def farthest_points(xyz: Tensor, count: int, first: int = 0) -> Tensor:
    """Return the indices [count] of points [N x 3], each the farthest from those before it.

    Eldar et al., 1997. A cloud of fewer points gives all of them, then repeats. `first` chooses
    where to begin: on a GPU at that point, on a CPU at one that follows from it.
    """
    number = len(xyz)
    if number <= count:
        return torch.arange(count, device=xyz.device) % max(number, 1)
    if xyz.device.type == 'cpu':
        import fpsample

        # Its fastest sampler begins where it likes, always at the same one of the same points;
        # turning the rows around makes that another point.
        points = np.roll(xyz.detach().numpy().astype(np.float32, copy=False), -first, axis=0)
        height = 7 if number > 8000 else 5
        points = np.ascontiguousarray(points)
        chosen = fpsample.bucket_fps_kdline_sampling(points, count, h=height, start_idx=0)
        return torch.from_numpy((chosen.astype(np.int64) + first) % number)
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
