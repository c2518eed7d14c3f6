"""Change submaps at random so that embeddings do not depend on what must not matter."""

import math

import torch
from torch import Tensor

from lcd_common.settings import config, setting


@config
class AugmentationConfig:
    """What is drawn for each submap; sizes in units of a submap.

    The papers turn a whole batch by 5 degrees at most, so their networks know a street in the
    direction of training alone; here each submap is turned anew, any way round.
    """

    yaw: float = setting(180.0, 'largest turn to either side', unit='deg', low=0.0, high=180.0)
    flip: float = setting(
        0.25, 'share of the batches mirrored at x, and at y, all submaps alike', low=0.0, high=1.0
    )
    shift: float = setting(0.01, 'deviation of the shift along each axis', low=0.0)
    jitter: float = setting(0.001, "deviation of each point's shift, cut off at twice it", low=0.0)
    removed: float = setting(0.1, 'largest share of the points removed', low=0.0, high=0.9)
    erased: float = setting(0.4, 'share of the submaps with an erased block', low=0.0, high=1.0)
    erased_most: float = setting(0.33, 'largest share of the area erased', low=0.02, high=1.0)


def augmented(points: Tensor, settings: AugmentationConfig, generator: torch.Generator) -> Tensor:
    """Return changed submaps [B x P x 3].

    A removed point becomes a copy of one that stays (the authors move them to the origin, where
    they make a voxel of their own).

    Args:
        points: [B x P x 3].
        settings: what is drawn.
        generator: on the CPU, so that every device draws the same.
    """
    s, device = settings, points.device
    clouds, number = points.shape[:2]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator).to(device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator).to(device)

    points = _kept(points, _left(points, s, uniform(clouds, number), uniform(clouds, 6)))
    if s.jitter:
        points = points + (s.jitter * normal(clouds, number, 3)).clamp(-2 * s.jitter, 2 * s.jitter)
    angle = (2.0 * uniform(clouds) - 1.0) * math.radians(s.yaw)
    c, sine = angle.cos()[:, None], angle.sin()[:, None]
    mirror = torch.where(uniform(2) < s.flip, -1.0, 1.0)
    x, y, z = points.unbind(2)
    turned = torch.stack(
        [(c * x - sine * y) * mirror[0], (sine * x + c * y) * mirror[1], z], 2
    )  # fmt: skip
    return turned + s.shift * normal(clouds, 1, 3)


def _left(points: Tensor, s: AugmentationConfig, drawn: Tensor, block: Tensor) -> Tensor:
    """Return the mask [B x P] of the points that are neither removed nor erased."""
    left = drawn >= s.removed * block[:, :1]
    low, high = points[..., :2].amin(1), points[..., :2].amax(1)
    least = min(0.02, s.erased_most)
    area = least + (s.erased_most - least) * block[:, 1]
    aspect = torch.exp((2.0 * block[:, 2] - 1.0) * math.log(3.0))
    size = torch.stack([(area * aspect).sqrt(), (area / aspect).sqrt()], 1).clamp(max=1.0)
    begin = low + (high - low) * (1.0 - size) * block[:, 3:5]
    end = begin + (high - low) * size
    within = ((points[..., :2] >= begin[:, None]) & (points[..., :2] <= end[:, None])).all(2)
    erased = (block[:, 5:] < s.erased) & within
    left &= ~erased
    # A block may not take the whole submap.
    return left | (left.sum(1) < points.shape[1] // 10)[:, None]


def _kept(points: Tensor, left: Tensor) -> Tensor:
    """Return the points with each that is not left replaced by the one left before it."""
    number = points.shape[1]
    place = torch.arange(number, device=points.device).expand_as(left)
    last = torch.where(left, place, -1).cummax(1).values
    first = left.float().argmax(1, keepdim=True)
    source = torch.where(last < 0, first, last)
    return points.gather(1, source[..., None].expand(-1, -1, 3))
