"""What is minimised: triplet, pose and transport losses (thesis equations 14 to 17)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from lcd_loop_closure.lcdnet.transport import SoftMatches


@dataclass(frozen=True)
class Losses:
    """Parts of the loss, each a number.

    Attributes:
        triplet: equation (14).
        pose: equation (15), metres.
        transport: equation (16), metres.
        violated: share of triplets that lie within the margin.
    """

    triplet: Tensor
    pose: Tensor
    transport: Tensor
    violated: float

    def total(self, beta: float, pose_weight: float = 1.0) -> Tensor:
        """Return the weighted sum (equation 17, where the pose has the weight 1)."""
        return self.triplet + pose_weight * self.pose + beta * self.transport


def triplet_loss(
    descriptors: Tensor,
    anchor: Tensor,
    positive: Tensor,
    different: Tensor,
    margin: float,
    hardest: bool = False,
) -> tuple[Tensor, float]:
    """Return the triplet loss and the share of anchors with a violated triplet (equation 14).

    Negatives are drawn online from the batch, at random among those that violate the margin, as the
    authors do; or the hardest is taken.

    Args:
        descriptors: [B x G].
        anchor, positive: [P] rows that show one place.
        different: [B x B] bool, whether two rows show different places.
        margin: m.
        hardest: take the nearest negative.
    """
    # The square root's slope has no bound at zero.
    gap = descriptors[:, None] - descriptors[None]
    distance = (gap.square().sum(2) + 1e-12).sqrt()
    near = distance[anchor, positive]
    far, allowed = distance[anchor], different[anchor]
    violating = allowed & (far < near[:, None] + margin)
    if hardest:
        chosen = torch.where(allowed, far, torch.inf).argmin(1)
    else:
        lots = torch.rand(far.shape, device=far.device)
        chosen = (lots + violating.float() + 2.0 * allowed.float()).argmax(1)
    loss = torch.relu(near - far[torch.arange(len(far)), chosen] + margin)
    loss = loss * allowed.any(1)
    return loss.mean(), float(violating.any(1).float().mean())


def separation_loss(
    descriptors: Tensor, same: Tensor, away: Tensor, temperature: float, farther_m: float
) -> tuple[Tensor, float]:
    """Return how badly pairs of one place stand out from all pairs that lie farther apart.

    Not in the thesis: log(1 + sum_n exp((s_n - s_p) / t)) for each pair p of one place, over all
    sweeps n that lie farther from its first sweep than its second. Every negative of a large batch
    counts by how much it is alike, and the nearest sweep of a street must be the most alike.

    Args:
        descriptors: [B x G], unit length.
        same: [B x B] bool, pairs that show one place.
        away: [B x B] how far apart, metres; NaN where a pair does not count.
        temperature: t.
        farther_m: farther by so much, n counts.

    Returns:
        The mean loss, and the share of pairs of one place that are less alike than a negative.
    """
    similarity = descriptors @ descriptors.T
    first, second = torch.nonzero(same, as_tuple=True)
    if not len(first):
        return similarity.sum() * 0.0, 0.0
    pair = similarity[first, second]
    different = away[first] > (away[first, second] + farther_m)[:, None]
    # Not minus infinity: of a row without a negative the sum would have no slope.
    against = (similarity[first] / temperature).masked_fill(~different, -1e4).logsumexp(1)
    loss = torch.nn.functional.softplus(against - pair / temperature)
    with torch.no_grad():
        confused = similarity[first].masked_fill(~different, -1.0).amax(1) > pair
    return loss.mean(), float(confused.float().mean())


def pose_loss(points: Tensor, T_predicted: Tensor, T_true: Tensor) -> Tensor:
    """Return how far points [P x N x 3] land from where they belong, mean L1 (equation 15)."""
    moved = _moved(T_predicted, points) - _moved(T_true, points)
    return moved.abs().sum(2).mean()


def transport_loss(matches: SoftMatches, points: Tensor, T_true: Tensor) -> Tensor:
    """Return how far soft matches lie from the true places, mean L1 (equation 16)."""
    return (matches.projected - _moved(T_true, points)).abs().sum(2).mean()


def _moved(T: Tensor, points: Tensor) -> Tensor:
    return points @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]


def matching_loss(
    cosine: Tensor,
    source: Tensor,
    target: Tensor,
    T_true: Tensor,
    *,
    near_m: float = 1.0,
    clear_m: float = 2.5,
    temperature: float = 0.07,
) -> Tensor:
    """Return how badly features tell a keypoint's true partner from the others (InfoNCE).

    Not in the thesis: it teaches features of keypoints one by one and so needs far fewer sweeps
    than the pose alone. Keypoints without a partner do not count.

    Args:
        cosine: [P x N x M] similarities of features.
        source, target: [P x N x 3], [P x M x 3] keypoints, metres.
        T_true: [P x 4 x 4] T_target_source.
        near_m: partners lie at most this far apart.
        clear_m: other keypoints nearer than this are no wrong answers.
        temperature: of the softmax.
    """
    distance = torch.cdist(_moved(T_true, source), target)
    nearest, at = distance.min(2)
    logits = cosine / temperature
    unclear = distance < clear_m
    unclear.scatter_(2, at[..., None], False)
    logits = logits.masked_fill(unclear, -torch.inf)
    has_partner = nearest < near_m
    if not bool(has_partner.any()):
        return logits.new_zeros(())
    return torch.nn.functional.cross_entropy(logits[has_partner], at[has_partner])
