"""Gather the neighbours of keypoints: ball query."""

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
    radius_m: float,
    count: int,
    *,
    points_batch: Tensor,
    centres_batch: Tensor,
    generator: np.random.Generator | None = None,
    crowd: int = 4,
) -> tuple[Tensor, Tensor]:
    """Return neighbours within a ball around each centre (thesis equation 3).

    A ball may hold more than `count` points; those taken are spread over the `crowd * count`
    nearest: evenly by their rank, or drawn at random with a generator (thesis equation 2 samples).

    Args:
        points: [M x 3] metres.
        centres: [N x 3] metres.
        radius_m: of the ball.
        count: neighbours to return.
        points_batch, centres_batch: [M], [N] cloud of the batch.
        generator: of random choices.
        crowd: how far the choice reaches.

    Returns:
        index [N x count] into points, and whether [N x count] it is a neighbour; the rest repeat
        the nearest one, and all are point 0 and False where the ball is empty.
    """
    wide = min(crowd * count, max(len(points), 1))
    if not len(points):
        shape = (len(centres), count)
        return (
            torch.zeros(shape, dtype=torch.long, device=centres.device),
            torch.zeros(shape, dtype=torch.bool, device=centres.device),
        )
    points, centres = points.detach().float(), centres.detach().float()
    search = _by_tree if centres.device.type == 'cpu' else _by_distances
    index, found = search(points, centres, radius_m, wide, points_batch, centres_batch)
    chosen = _spread(found, count, generator)
    index = torch.gather(index, 1, chosen)
    valid = torch.arange(count, device=found.device) < found.clamp(max=count)[:, None]
    return torch.where(valid, index, index[:, :1]), valid


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
    found = torch.from_numpy(np.isfinite(distance).sum(1))
    index = torch.from_numpy(np.where(np.isfinite(distance), index, 0))
    return index, found


def _by_distances(
    points: Tensor,
    centres: Tensor,
    radius_m: float,
    count: int,
    in_points: Tensor,
    in_centres: Tensor,
) -> tuple[Tensor, Tensor]:
    index = torch.zeros((len(centres), count), dtype=torch.long, device=centres.device)
    found = torch.zeros(len(centres), dtype=torch.long, device=centres.device)
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
            index[part, : at.shape[1]] = rows[at]
            found[part] = (nearest <= radius_m).sum(1)
    return index, found
