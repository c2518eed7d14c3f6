"""Gather the neighbours of keypoints: ball query."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

# Clouds of a batch are searched in one go, so far apart that no ball reaches over.
_APART_M = 10_000.0
_AT_ONCE = 1 << 25  # distances held at a time on a GPU


def ball_query(
    points: Tensor,
    centres: Tensor,
    balls: Sequence[tuple[float, int]],
    *,
    points_batch: Tensor,
    centres_batch: Tensor,
    generator: np.random.Generator | None = None,
    crowd: int = 4,
) -> list[tuple[Tensor, Tensor]]:
    """Return neighbours within balls around each centre (thesis equation 3).

    A ball may hold more points than are asked for; those taken are spread over the `crowd * count`
    nearest: evenly by their rank, or drawn at random with a generator (thesis equation 2 samples).
    All balls are searched at once: the nearest of the largest hold those of the others.

    Args:
        points: [M x 3] metres.
        centres: [N x 3] metres.
        balls: radius, metres, and count of neighbours to return, of each.
        points_batch, centres_batch: [M], [N] cloud of the batch.
        generator: of random choices.
        crowd: how far the choice reaches.

    Returns:
        For each ball index [N x count] into points, and whether [N x count] it is a neighbour; the
        rest repeat the nearest one, and all are point 0 and False where the ball is empty.
    """
    if not len(points):
        shapes = [(len(centres), count) for _, count in balls]
        return [
            (
                torch.zeros(shape, dtype=torch.long, device=centres.device),
                torch.zeros(shape, dtype=torch.bool, device=centres.device),
            )
            for shape in shapes
        ]
    points, centres = points.detach().float(), centres.detach().float()
    search = _by_tree if centres.device.type == 'cpu' else _by_distances
    widest, most = max(radius for radius, _ in balls), max(count for _, count in balls)
    wide = min(crowd * most, len(points))
    index, distance = search(points, centres, widest, wide, points_batch, centres_batch)
    found = []
    for radius_m, count in balls:
        inside = (distance <= radius_m).sum(1).clamp(max=crowd * count)
        chosen = torch.gather(index, 1, _spread(inside, count, generator))
        valid = torch.arange(count, device=inside.device) < inside.clamp(max=count)[:, None]
        first = torch.where(valid[:, :1], chosen[:, :1], 0)
        found.append((torch.where(valid, chosen, first), valid))
    return found


def _spread(found: Tensor, count: int, generator: np.random.Generator | None) -> Tensor:
    """Return ranks [N x count] among the first `found` [N] ones, the nearest always first."""
    step = torch.arange(count, device=found.device)
    share = step / count
    if generator is not None:
        drawn = torch.as_tensor(generator.random((len(found), count), np.float32))
        share = share + (drawn / count).to(found.device)
        share[:, 0] = 0.0
    else:
        share = share[None].expand(len(found), count)
    over = (share * found[:, None]).long()
    return torch.where(found[:, None] > count, over, step.clamp(max=count - 1)[None]).clamp(
        max=(found.max().clamp(min=1) - 1) if len(found) else 0
    )


def _by_tree(
    points: Tensor,
    centres: Tensor,
    radius_m: float,
    count: int,
    in_points: Tensor,
    in_centres: Tensor,
) -> tuple[Tensor, Tensor]:
    far = np.array([0.0, 0.0, _APART_M])
    tree = cKDTree(
        points.numpy() + in_points.numpy()[:, None] * far,
        balanced_tree=False,
        compact_nodes=False,
    )
    distance, index = tree.query(
        centres.numpy() + in_centres.numpy()[:, None] * far,
        k=np.arange(1, count + 1),
        distance_upper_bound=radius_m,
        workers=torch.get_num_threads(),
    )
    index = torch.from_numpy(np.where(np.isfinite(distance), index, 0))
    return index, torch.from_numpy(distance)


def _by_distances(
    points: Tensor,
    centres: Tensor,
    radius_m: float,
    count: int,
    in_points: Tensor,
    in_centres: Tensor,
) -> tuple[Tensor, Tensor]:
    index = torch.zeros((len(centres), count), dtype=torch.long, device=centres.device)
    found = torch.full((len(centres), count), torch.inf, device=centres.device)
    for cloud in torch.unique(in_centres).tolist():
        rows = torch.nonzero(in_points == cloud)[:, 0]
        if not len(rows):
            continue
        for part in torch.nonzero(in_centres == cloud)[:, 0].split(max(1, _AT_ONCE // len(rows))):
            # Differences, not the expanded square: metres apart at tens of metres lose digits.
            distance = torch.cdist(
                centres[part], points[rows], compute_mode='donot_use_mm_for_euclid_dist'
            )
            nearest, at = torch.topk(distance, min(count, len(rows)), dim=1, largest=False)
            inside = nearest <= radius_m
            index[part, : at.shape[1]] = torch.where(inside, rows[at], 0)
            found[part, : at.shape[1]] = torch.where(inside, nearest, torch.inf)
    return index, found
