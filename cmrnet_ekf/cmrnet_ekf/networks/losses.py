"""What training makes small: equations 27 to 32 of the thesis, and two losses beside them."""

from dataclasses import dataclass
from math import log, pi

import torch
from torch import Tensor
from torch.nn import functional

from cmrnet_ekf.euler import quaternion_of_euler, wrapped_tensor
from cmrnet_ekf.networks.outputs import Evidence, GaussianPose, Output, QuaternionPose
from lcd_common.settings import config, setting

TRANSLATION, ROTATION = slice(0, 3), slice(3, 6)


@config
class LossConfig:
    """Weights; the defaults are the thesis's (section 5.3.2)."""

    density: str = setting(
        'inverse',
        'what L^D is made of: the inverse of the density, or, as in Amini et al., the negative '
        'logarithm of it with the plain distance in L^R',
        choices=('inverse', 'log'),
    )
    geometric: bool = setting(True, 'with the geometric loss beside the evidential one')
    density_floor: float = setting(0.04, 'lower densities count as that', low=1e-6)
    unit_rotation: float = setting(
        1.0,
        'in which L^evd measures angles (thesis: radians). Where 1/p stays under 1 the smooth L1 '
        'of L^D is a square, which is least for a density that is far too wide',
        unit='rad',
        low=1e-6,
    )
    unit_translation: float = setting(
        1.0, 'in which L^evd measures translations (thesis: metres)', unit='m', low=1e-6
    )
    scale_rotation: float = setting(1.0, 's_rot', low=0.0)
    scale_translation: float = setting(1.0, 's_tr', low=0.0)
    matching_weight: float = setting(
        0.0, 'weight of the matching loss, which is not in the thesis', low=0.0
    )
    matching_sharpness: float = setting(
        10.0, 'factor of the correlation before the softmax of the matching loss', low=0.1
    )
    lambda_rotation: float = setting(0.01, 'weight of L^R of rotations', low=0.0)
    lambda_translation: float = setting(0.1, 'weight of L^R of translations', low=0.0)
    evidence_first: float = setting(0.1, 's^evd of the first step of training', low=0.0)
    evidence_second: float = setting(0.005, 's^evd of the second step', low=0.0)
    first_share: float = setting(
        0.375, 'of the training, which is the first step (thesis: 150 of 400 epochs)', low=0, high=1
    )

    def evidence_scale(self, share: float) -> float:
        """Return s^evd when a share of the training is done."""
        return self.evidence_first if share < self.first_share else self.evidence_second


@dataclass(frozen=True)
class Losses:
    """Losses of a batch: the whole, and its parts before weights."""

    total: Tensor
    translation: Tensor
    rotation: Tensor
    evidence: Tensor


def pose_losses(output: Output, target: Tensor, settings: LossConfig, evidence: float) -> Losses:
    """Return the losses of an output.

    Args:
        output: of the network.
        target: [B x 6] components of the true T_guess_camera.
        settings: weights.
        evidence: s^evd (equation 31), for heads that say how sure they are.
    """
    s = settings
    if isinstance(output, QuaternionPose):
        translation = translation_loss(target[:, :3] - output.translation)
        rotation = quaternion_distance(output.quaternion, quaternion_of_euler(target[:, 3:])).mean()
        total = s.scale_translation * translation + s.scale_rotation * rotation
        return Losses(total, translation, rotation, total.new_zeros(()))
    mean = output.gamma if isinstance(output, Evidence) else output.mean
    error = residual(target, mean)
    translation, rotation = translation_loss(error[:, :3]), translation_loss(error[:, 3:])
    shared = float(s.geometric)
    if isinstance(output, GaussianPose):
        uncertain = gaussian_loss(output, error)
        total = shared * (s.scale_translation * translation + s.scale_rotation * rotation)
        return Losses(total + evidence * uncertain, translation, rotation, uncertain)
    of_t = evidential_loss(output, error, TRANSLATION, s)
    of_r = evidential_loss(output, error, ROTATION, s)
    total = s.scale_rotation * (shared * rotation + evidence * of_r) + s.scale_translation * (
        shared * translation + evidence * of_t
    )
    return Losses(total, translation, rotation, of_t + of_r)


def residual(target: Tensor, mean: Tensor) -> Tensor:
    """Return target - mean [B x 6]; differences of angles go the short way round."""
    difference = target - mean
    return torch.cat([difference[:, :3], wrapped_tensor(difference[:, 3:])], 1)


def translation_loss(error: Tensor) -> Tensor:
    """Return L^G: smooth L1 of errors [B x 3], summed over the components, mean of the batch."""
    return functional.smooth_l1_loss(error, torch.zeros_like(error), reduction='none').sum(1).mean()


def quaternion_distance(one: Tensor, other: Tensor) -> Tensor:
    """Return the angle [B] between rotations x y z w [B x 4], radians."""
    vector = (
        one[:, 3:] * other[:, :3]
        - other[:, 3:] * one[:, :3]
        - torch.linalg.cross(one[:, :3], other[:, :3])
    )
    real = (one * other).sum(1)
    # The root of 0 has no gradient.
    length = (vector.square().sum(1) + 1e-14).sqrt()
    return 2.0 * torch.atan2(length, real.abs())


def log_density(evidence: Evidence, error: Tensor) -> Tensor:
    """Return log p(y|m): the Student-t density of errors y - gamma, elementwise."""
    freedom, squared = evidence.degrees_of_freedom, evidence.squared_scale
    return (
        torch.lgamma(0.5 * (freedom + 1.0))
        - torch.lgamma(0.5 * freedom)
        - 0.5 * torch.log(pi * freedom * squared)
        - 0.5 * (freedom + 1.0) * torch.log1p(error.square() / (freedom * squared))
    )


def evidential_loss(evidence: Evidence, error: Tensor, of: slice, settings: LossConfig) -> Tensor:
    """Return L^evd (equation 30) of the translations or of the rotations, mean of the batch.

    Equations 29, or 28 with `density` log; the distance d of 29 is the smooth L1. The density is
    that per unit of the settings, the distance is in those units.
    """
    turned = of == ROTATION
    unit = settings.unit_rotation if turned else settings.unit_translation
    weight = settings.lambda_rotation if turned else settings.lambda_translation
    log_p, phi = log_density(evidence, error)[:, of] + log(unit), evidence.amount[:, of]
    error = error[:, of] / unit
    if settings.density == 'log':
        return (-log_p + weight * error.abs() * phi).mean()
    inverse = torch.exp(torch.clamp(-log_p, max=-log(settings.density_floor)))
    nothing = torch.zeros_like(error)
    distance = functional.smooth_l1_loss(error, nothing, reduction='none')
    return functional.smooth_l1_loss(inverse, nothing) + weight * (distance * phi).mean()


def gaussian_loss(pose: GaussianPose, error: Tensor) -> Tensor:
    """Return the mean negative log-likelihood of errors [B x 6], without its constant."""
    whitened = torch.einsum('bij,bi->bj', pose.information_root, error)
    log_root = torch.diagonal(pose.information_root, dim1=1, dim2=2).log().sum(1)
    return (0.5 * whitened.square().sum(1) - log_root).mean()
