"""Make LiDAR images with torch, on any device; pixel for pixel what `on_cpu` makes."""

import torch
from torch import Tensor

from cmrnet_ekf.lidar_image.lens import Lens
from cmrnet_ekf.lidar_image.settings import LidarImageConfig


def depth_image(points: Tensor, T_camera_points: Tensor, lens: Lens, s: LidarImageConfig) -> Tensor:
    """Return the depth [H x W] of the nearest point in each pixel, metres; 0 where there is none.

    Args:
        points: [N x 3] float32.
        T_camera_points: [4 x 4] from the points' frame to the camera's optical frame.
        lens: of the camera.
        s: which depths count. Nothing is filtered here.
    """
    T = T_camera_points.to(points.device, torch.float32)
    px, py, pz = points.unbind(1)
    # Products and sums one by one, not a matrix product: its order of rounding is the library's.
    z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
    inverse = 1.0 / z
    x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) * inverse
    y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) * inverse
    kept = (z >= s.min_depth) & (z <= s.max_depth)
    if lens.distortion.any():
        k1, k2, p1, p2, k3 = torch.from_numpy(lens.distortion).to(points.device)
        r2 = x * x + y * y
        kept &= r2 < lens.max_radius_squared
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        x = bent
    (fx, fy), (cx, cy) = (points.new_tensor(pair) for pair in (lens.focal, lens.centre))
    column, row = torch.floor(fx * x + cx + 0.5), torch.floor(fy * y + cy + 0.5)
    kept &= (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
    at = (row[kept] * lens.width + column[kept]).long()
    depth = points.new_full((lens.height * lens.width,), torch.inf)
    depth.scatter_reduce_(0, at, z[kept], 'amin')
    return torch.where(depth.isinf(), 0.0, depth).view(lens.height, lens.width)


def without_hidden(depth: Tensor, lens: Lens, s: LidarImageConfig) -> Tensor:
    """Return the images [... x H x W] without pixels that see through a nearer surface.

    See `on_cpu.without_hidden`.
    """
    if s.radius == 0:
        return depth
    rays = torch.from_numpy(lens.rays).to(depth.device)
    filled = depth > 0
    x, y, z = rays[..., 0] * depth, rays[..., 1] * depth, depth
    own = _root(x * x + y * y + z * z)
    r = s.radius
    pad = (r, r, r, r)
    nothing = torch.nn.functional.pad(torch.where(filled, z, torch.nan), pad, value=torch.nan)
    x_far, y_far = (torch.nn.functional.pad(a, pad, value=0.0) for a in (x, y))
    height, width = depth.shape[-2:]
    best = [torch.full_like(depth, -torch.inf) for _ in range(4)]
    for down in range(-r, r + 1):
        for right in range(-r, r + 1):
            if down == right == 0:
                continue
            there = (..., slice(r + down, r + down + height), slice(r + right, r + right + width))
            dx, dy, dz = x_far[there] - x, y_far[there] - y, nothing[there] - z
            along = -(dx * x + dy * y + dz * z)
            square = dx * dx + dy * dy + dz * dz
            cosine = torch.nan_to_num(along * along.abs() / square, nan=-torch.inf)
            for quadrant in _quadrants(down, right):
                best[quadrant] = torch.maximum(best[quadrant], cosine)
    covered = torch.zeros_like(depth)
    for of_quadrant in best:
        cosine = torch.sign(of_quadrant) * (_root(of_quadrant.abs()) / own)
        covered = covered + torch.where(of_quadrant.isinf(), -1.0, cosine)
    threshold = torch.tensor(s.threshold, dtype=torch.float32, device=depth.device)
    return torch.where(filled & ~(covered >= threshold), depth, 0.0)


def _root(square: Tensor) -> Tensor:
    """Return the root, rounded correctly: torch's own in float32 is off by one digit at times."""
    return square.double().sqrt().float()


def _quadrants(down: int, right: int) -> list[int]:
    """Return which quadrants a neighbour belongs to: above, then below, left before right."""
    vertical = [0] * (down <= 0) + [2] * (down >= 0)
    return [v + h for v in vertical for h in [0] * (right <= 0) + [1] * (right >= 0)]
