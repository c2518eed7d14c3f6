"""Hold what a network believes about poses, whichever way it became uncertain."""

from dataclasses import dataclass

import numpy as np

from cmrnet_ekf import euler
from lcd_common import se3

Array = se3.Array


@dataclass(frozen=True)
class PoseBelief:
    """Distributions of N poses T_guess_camera, by component: x y z (m), roll pitch yaw (rad).

    Attributes:
        mean: [N x 6].
        scale: [N x 6] of a Gaussian (its standard deviation) or a Student-t distribution.
        freedom: [N x 6] degrees of freedom; infinity is a Gaussian.
        epistemic: [N x 6] the part of the variance that more training would remove.
        correlation: [N x 6 x 6], None where components are independent.
    """

    mean: Array
    scale: Array
    freedom: Array
    epistemic: Array
    correlation: Array | None = None

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def variance(self) -> Array:
        """Predictive variance [N x 6]; infinite with 2 degrees of freedom or less."""
        with np.errstate(divide='ignore', invalid='ignore'):
            excess = np.where(np.isinf(self.freedom), 1.0, self.freedom / (self.freedom - 2.0))
        excess = np.where(self.freedom <= 2.0, np.inf, excess)
        return np.asarray(np.square(self.scale) * excess, np.float64)

    @property
    def covariance(self) -> Array:
        """Covariance [N x 6 x 6] of the components."""
        deviation = np.sqrt(self.variance)
        correlation = np.eye(6) if self.correlation is None else self.correlation
        with np.errstate(invalid='ignore'):
            covariance = deviation[:, :, None] * correlation * deviation[:, None, :]
        return np.where(correlation == 0.0, 0.0, covariance)  # infinity times 0 too

    @property
    def transforms(self) -> Array:
        """T_guess_camera [N x 4 x 4] of the means."""
        return euler.transforms(self.mean)

    def row(self, index: int) -> 'PoseBelief':
        """Return one of the beliefs as a belief of one pose."""
        return self.rows(slice(index, index + 1))

    def rows(self, which: 'slice | np.ndarray') -> 'PoseBelief':
        """Return some of the beliefs."""
        correlation = None if self.correlation is None else self.correlation[which]
        return PoseBelief(
            self.mean[which],
            self.scale[which],
            self.freedom[which],
            self.epistemic[which],
            correlation,
        )

    def errors(self, target: Array) -> Array:
        """Return target - mean [N x 6]; angles the short way round."""
        difference = target - self.mean
        difference[:, 3:] = euler.wrapped(difference[:, 3:])
        return np.asarray(difference, np.float64)


def gaussian_of_samples(samples: Array) -> PoseBelief:
    """Return the Gaussians of sampled components [S x N x 6] (equations 24 and 25).

    The variance is the thesis's: the mean of squares, not divided by one less.
    """
    spread = samples - samples[:1]
    spread[..., 3:] = euler.wrapped(spread[..., 3:])
    mean = samples[0] + spread.mean(0)
    mean[:, 3:] = euler.wrapped(mean[:, 3:])
    variance = spread.var(0)
    return PoseBelief(mean, np.sqrt(variance), np.full_like(variance, np.inf), variance)


def joined(beliefs: 'list[PoseBelief]') -> PoseBelief:
    """Return several beliefs as one."""
    correlations = [b.correlation for b in beliefs if b.correlation is not None]
    return PoseBelief(
        np.concatenate([b.mean for b in beliefs]),
        np.concatenate([b.scale for b in beliefs]),
        np.concatenate([b.freedom for b in beliefs]),
        np.concatenate([b.epistemic for b in beliefs]),
        np.concatenate(correlations) if len(correlations) == len(beliefs) else None,
    )
