"""Judge uncertainties: calibration curves, sharpness, sparsification.

Kuleshov et al., "Accurate Uncertainties for Deep Learning Using Calibrated Regression", ICML 2018;
thesis section 5.3.5. Nothing here is fitted.
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from cmrnet_ekf.pose_belief import PoseBelief
from lcd_common.errors import DataError
from lcd_common.se3 import Array

LEVELS: Array = np.linspace(0.01, 0.99, 99)
AXES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')


@dataclass(frozen=True)
class CalibrationCurve:
    """How often errors lie within central intervals [99] that should hold them `expected` [99]."""

    expected: Array
    observed: Array

    @property
    def mean_error(self) -> float:
        """Mean distance from the diagonal (MACE), as in Table 5.3."""
        return float(np.abs(self.expected - self.observed).mean())

    @property
    def std_error(self) -> float:
        """Spread of the distances from the diagonal."""
        return float(np.abs(self.expected - self.observed).std())


def calibration_curve(errors: Array, scale: Array, freedom: Array | float) -> CalibrationCurve:
    """Return the curve of one component on central intervals.

    Args:
        errors: [N] target - mean.
        scale: [N] of a Student-t distribution, standard deviation of a Gaussian.
        freedom: [N] or one: degrees of freedom; infinity is a Gaussian.

    Raises:
        DataError: there are no errors, or something is not finite or a scale not positive.
    """
    if not len(errors):
        raise DataError('a calibration curve needs errors, got none')
    if not np.isfinite(errors).all() or not np.isfinite(scale).all() or (scale <= 0).any():
        raise DataError('a calibration curve needs finite errors and positive scales')
    # The share of the distribution that is nearer than the error: uniform when it is right.
    nearer = central_probability(np.abs(errors) / scale, freedom)
    observed = np.searchsorted(np.sort(nearer), LEVELS, side='right') / len(nearer)
    return CalibrationCurve(LEVELS, observed)


def central_probability(standardised: Array, freedom: Array | float) -> Array:
    """Return the probability of the interval +-standardised [N] of Student-t or normal laws."""
    freedom = np.broadcast_to(np.asarray(freedom, np.float64), np.shape(standardised))
    normal = np.isinf(freedom)
    tail = np.where(
        normal,
        stats.norm.sf(standardised),
        stats.t.sf(standardised, np.where(normal, 1.0, freedom)),
    )
    return np.asarray(1.0 - 2.0 * tail, np.float64)


def calibration(belief: PoseBelief, target: Array) -> dict[str, CalibrationCurve]:
    """Return the curve of each component, by its name."""
    errors = belief.errors(target)
    return {
        axis: calibration_curve(errors[:, k], belief.scale[:, k], belief.freedom[:, k])
        for k, axis in enumerate(AXES)
    }


def sharpness(belief: PoseBelief) -> Array:
    """Return the root of the mean predictive variance [6]: small is informative."""
    return np.asarray(np.sqrt(belief.variance.mean(0)), np.float64)


def sparsification(errors: Array, uncertainty: Array, shares: Array) -> Array:
    """Return the mean error of what is left when the most uncertain shares [S] are discarded."""
    order = np.argsort(uncertainty, kind='stable')
    means = np.cumsum(errors[order]) / np.arange(1, len(errors) + 1)
    kept = np.maximum(np.round((1.0 - shares) * len(errors)).astype(int), 1)
    return np.asarray(means[kept - 1], np.float64)


def ause(errors: Array, uncertainty: Array) -> float:
    """Return the area between sparsification by uncertainty and by the error itself.

    Errors [N] are not negative; the curves are divided by the mean error. 0 is a perfect order;
    what uncertainties that say nothing get depends on the errors (half of Gini's coefficient).
    """
    if not len(errors) or (errors < 0).any() or not errors.any():
        raise DataError('AUSE needs errors that are not negative and not all zero')
    shares = np.linspace(0.0, 0.99, 100)
    by_uncertainty = sparsification(errors, uncertainty, shares)
    by_error = sparsification(errors, errors, shares)
    gap = (by_uncertainty - by_error) / errors.mean()
    return float(np.trapezoid(gap, shares))
