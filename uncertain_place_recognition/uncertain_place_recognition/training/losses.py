"""What embeddings are trained by: places apart from one another, or like a teacher's."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class MetricLoss:
    """A loss over a batch.

    Attributes:
        loss: scalar.
        active: share of the anchors that still violate their margin; of smooth AP and the
            contrastive loss: whose nearest is a negative.
    """

    loss: Tensor
    active: float


def batch_hard_triplet(
    embeddings: Tensor, positive: Tensor, negative: Tensor, margin: float = 0.2
) -> MetricLoss:
    """Return the triplet loss of the hardest triplet of each anchor (thesis equation 20).

    MinkLoc3D's: Euclidean distances, the negative's distance from anchor or positive (`swap`),
    whichever is less, and the mean over the triplets that are not yet satisfied.

    Args:
        embeddings: [B x D].
        positive, negative: [B x B] masks.
        margin: m.
    """
    distance = distances(embeddings)
    anchors = positive.any(1) & negative.any(1)
    far, p = distance.masked_fill(~positive, -torch.inf).max(1)
    near, n = distance.masked_fill(~negative, torch.inf).min(1)
    near = torch.minimum(near, distance[p, n])
    # Rows without a pair hold infinities, whose gradients are no numbers.
    violated = functional.relu(far[anchors] - near[anchors] + margin)
    return _mean_of_active(violated, embeddings)


def lazy_quadruplet(
    embeddings: Tensor,
    positive: Tensor,
    negative: Tensor,
    generator: torch.Generator,
    margins: tuple[float, float] = (0.5, 0.2),
) -> MetricLoss:
    """Return PointNetVLAD's loss: squared distances, the nearest positive, the worst negative.

    The other negative of each anchor, different from it and from all negatives that it meets, is
    drawn.

    Args:
        embeddings: [B x D].
        positive, negative: [B x B] masks.
        generator: on the CPU.
        margins: of the triplets and of the other negative.
    """
    squared = distances(embeddings) ** 2
    drawn = torch.rand(negative.shape, generator=generator).to(negative.device)
    other = torch.where(negative, drawn, -1.0).argmax(1)
    anchors = positive.any(1) & negative.any(1)
    near = squared.masked_fill(~positive, torch.inf).amin(1)
    first = squared.masked_fill(~negative, torch.inf).amin(1)
    meets = negative & negative[other]
    second = squared[other].masked_fill(~meets, torch.inf).amin(1)
    by_triplet = functional.relu(margins[0] + near[anchors] - first[anchors])
    # An anchor whose other negative meets no third has no second term: relu(-inf) is zero.
    met = meets.any(1)[anchors]
    by_other = torch.zeros_like(by_triplet)
    by_other[met] = functional.relu(margins[1] + near[anchors][met] - second[anchors][met])
    active = float((by_triplet > 0).float().mean()) if len(by_triplet) else 0.0
    loss = (by_triplet + by_other).mean() if len(by_triplet) else embeddings.sum() * 0.0
    return MetricLoss(loss, active)


def truncated_smooth_ap(
    embeddings: Tensor,
    positive: Tensor,
    negative: Tensor,
    temperature: float = 0.01,
    closest: int = 4,
) -> MetricLoss:
    """Return 1 - the smoothed average precision of the closest positives (MinkLoc3Dv2).

    Ranks are sums of sigmoids of differences of similarities, which are negative distances.

    Args:
        embeddings: [B x D].
        positive, negative: [B x B] masks.
        temperature: of the sigmoids.
        closest: positives of each anchor that count.
    """
    similarity = -distances(embeddings)
    count = min(closest, len(embeddings))
    best, chosen = similarity.masked_fill(~positive, -torch.inf).topk(count, dim=1)
    real = torch.isfinite(best)
    # [B x closest x B]: by how much every other one is more similar than the positive.
    ahead = similarity[:, None] - similarity.gather(1, chosen)[..., None]
    above = torch.sigmoid(ahead / temperature)
    itself = functional.one_hot(chosen, len(embeddings)).bool()
    among = 1.0 + (above * (positive[:, None] & ~itself)).sum(2)
    precision = among / (among + (above * negative[:, None]).sum(2))
    loss = 1.0 - precision[real].mean() if bool(real.any()) else embeddings.sum() * 0.0
    anchors = real[:, 0]
    missed = (similarity.masked_fill(~negative, -torch.inf).amax(1) > best[:, 0])[anchors]
    return MetricLoss(loss, float(missed.float().mean()) if len(missed) else 0.0)


def contrastive(
    embeddings: Tensor, positive: Tensor, negative: Tensor, temperature: float = 0.1
) -> MetricLoss:
    """Return the mean over positive pairs of log(1 + sum_n exp((s_n - s_p) / t)), s by cosine.

    InfoNCE (van den Oord et al., 2018): every negative counts by how much it is alike, not the
    hardest alone, so that small batches teach from the start.

    Args:
        embeddings: [B x D].
        positive, negative: [B x B] masks.
        temperature: t.
    """
    unit = functional.normalize(embeddings, dim=1)
    scaled = unit @ unit.T / temperature
    # Not minus infinity: of a row without a negative the sum would have no slope.
    against = scaled.masked_fill(~negative, -1e4).logsumexp(1)
    loss = functional.softplus(against[:, None] - scaled)[positive]
    if not len(loss):
        return MetricLoss(embeddings.sum() * 0.0, 0.0)
    anchors = positive.any(1)
    worst = scaled.masked_fill(~negative, -torch.inf).amax(1)
    best = scaled.masked_fill(~positive, -torch.inf).amax(1)
    return MetricLoss(loss.mean(), float((worst > best)[anchors].float().mean()))


def distillation(student: Tensor, teacher: Tensor) -> Tensor:
    """Return the smooth L1 distance of embeddings [B x D] to the teacher's (thesis equation 21).

    Summed over the features: their mean is so small that weight decay would outweigh it.
    """
    return functional.smooth_l1_loss(student, teacher, reduction='none').sum(1).mean()


def gaussian_likelihood(mean: Tensor, variance: Tensor, teacher: Tensor) -> Tensor:
    """Return STUN's loss, the sum over features of (mu_t - mu)^2 / (2 var) + log(var) / 2."""
    return ((teacher - mean) ** 2 / (2.0 * variance) + 0.5 * variance.log()).sum(1).mean()


def distances(embeddings: Tensor) -> Tensor:
    """Return Euclidean distances [B x B]; not by way of products, which lose small ones."""
    return torch.cdist(embeddings, embeddings, compute_mode='donot_use_mm_for_euclid_dist')


def _mean_of_active(violated: Tensor, embeddings: Tensor) -> MetricLoss:
    active = violated > 0
    if not bool(active.any()):
        return MetricLoss(embeddings.sum() * 0.0, 0.0)
    return MetricLoss(violated[active].mean(), float(active.float().mean()))
