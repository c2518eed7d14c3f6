"""Vary samples as CMRNet's authors do: mirrored, in other colours, rolled."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cmrnet_ekf import euler
from cmrnet_ekf.training.batch import Batch
from lcd_common import se3

# What a mirror does to x y z roll pitch yaw.
_MIRRORED = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])


def augmented(batch: Batch, rng: np.random.Generator, roll: float) -> Batch:
    """Return samples that differ.

    Each is mirrored with a probability of a half, its brightness, contrast and saturation vary by
    a tenth, and both images are rolled by up to an angle, radians.
    """
    image = jittered(batch.image.float(), rng)
    mirror = torch.from_numpy(rng.random(len(image)) < 0.5)
    batch = mirrored(replace(batch, image=image), mirror)
    if not roll:
        return batch
    return rolled(batch, rng.uniform(-roll, roll, len(image)))


def rolled(batch: Batch, radians: se3.Array) -> Batch:
    """Return samples as if camera and guess were rolled by angles [B] about their forward axes.

    The street does not change: every ray keeps its depth, and T_guess_camera is turned by the roll
    on both sides. Needs the pinhole of each sample; what comes from beyond the border is empty.
    """
    height, width = batch.image.shape[2:]
    angle = torch.from_numpy(np.asarray(radians)).float().to(batch.image.device).view(-1, 1, 1)
    fx, fy, cx, cy = (part.view(-1, 1, 1) for part in batch.camera.unbind(1))
    columns = torch.arange(width, device=angle.device).view(1, 1, -1)
    rows = torch.arange(height, device=angle.device).view(1, -1, 1)
    x, y = (columns - cx) / fx, (rows - cy) / fy
    u = (torch.cos(angle) * x - torch.sin(angle) * y) * fx + cx
    v = (torch.sin(angle) * x + torch.cos(angle) * y) * fy + cy
    # Of pixel centres: -1 and 1 are the first and the last.
    grid = torch.stack([2.0 * u / (width - 1) - 1.0, 2.0 * v / (height - 1) - 1.0], 3)
    image = functional.grid_sample(batch.image.float(), grid, align_corners=True)
    # Depths of neighbours do not mix.
    lidar = functional.grid_sample(batch.lidar[:, None], grid, mode='nearest', align_corners=True)
    T = euler.transforms(batch.target.double().cpu().numpy())
    turn = np.tile(np.eye(4), (len(T), 1, 1))
    turn[:, :3, :3] = [se3.so3_exp([float(one), 0.0, 0.0]) for one in radians]
    target = torch.from_numpy(euler.components(se3.inverse(turn) @ T @ turn))
    return replace(
        batch, image=image, lidar=lidar[:, 0], target=target.float().to(batch.target.device)
    )


def mirrored(batch: Batch, which: Tensor) -> Batch:
    """Return the batch with some samples [B] as a mirror would show the street.

    Both images are flipped: the flipped LiDAR image is what a camera with a mirrored principal
    point sees of the mirrored map.
    """
    keep = which.view(-1, 1, 1, 1)
    fx, fy, cx, cy = batch.camera.unbind(1)
    flipped = torch.stack([fx, fy, batch.image.shape[3] - 1 - cx, cy], 1)
    return Batch(
        torch.where(keep, batch.image.flip(3), batch.image),
        torch.where(keep[:, 0], batch.lidar.flip(2), batch.lidar),
        torch.where(which.view(-1, 1), batch.target * _MIRRORED, batch.target),
        torch.where(which.view(-1, 1), flipped, batch.camera),
    )


def jittered(image: Tensor, rng: np.random.Generator, amount: float = 0.1) -> Tensor:
    """Return images [B x 3 x H x W], 0..255, with other brightness, contrast and saturation."""
    factors = torch.from_numpy(rng.uniform(1 - amount, 1 + amount, (3, len(image), 1, 1, 1)))
    brightness, contrast, saturation = factors.float()
    image = image * brightness
    image = (image - image.mean((1, 2, 3), keepdim=True)) * contrast + image.mean(
        (1, 2, 3), keepdim=True
    )
    grey = image.mean(1, keepdim=True)
    return ((image - grey) * saturation + grey).clamp(0.0, 255.0)
