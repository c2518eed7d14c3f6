"""Refuse covariances that are none, and say what came."""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError


def used_covariance(covariance: se3.Array, axes: NDArray[np.bool_], what: str) -> se3.Array:
    """Return a covariance whose used rows are good; the unused ones become 1 and independent.

    Drivers put anything into the rows of what they do not measure (-1, zeros, 1e9), so only the
    used ones are judged. Nothing is mended: a driver that sends a broken one is wrong elsewhere.

    Args:
        covariance: [n x n].
        axes: [n], which rows the filter uses.
        what: the observation, for people.

    Raises:
        DataError: not n x n, NaN or infinite, a variance that is negative or zero, not symmetric,
            or not positive definite.
    """
    n = len(axes)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (n, n):
        raise DataError(f'{what}: expected a {n} x {n} covariance, got {covariance.shape}')
    used = covariance[np.ix_(axes, axes)]
    problem = _problem(used)
    if problem:
        variances = ', '.join(f'{v:.3g}' for v in np.diag(used))
        raise DataError(f'{what}: the covariance {problem}; its used variances are {variances}')
    out = np.eye(n)
    out[np.ix_(axes, axes)] = 0.5 * (used + used.T)
    return out


def _problem(used: se3.Array) -> str:
    if not np.isfinite(used).all():
        return 'is not finite'
    if not used.any():
        return 'is all zero, which means unknown: give one, or set the sigmas of this input'
    variances = np.diag(used)
    if (variances < 0.0).any():
        return 'has a negative variance'
    if (variances == 0.0).any():
        return 'has a variance of zero: nothing is known exactly'
    # Relative to the rows' own size: metres and radians stand side by side.
    scale = np.sqrt(variances)
    relative = used / np.outer(scale, scale)
    if np.abs(relative - relative.T).max() > 1e-6:
        return 'is not symmetric'
    if np.linalg.eigvalsh(0.5 * (relative + relative.T))[0] <= 0.0:
        return 'is not positive definite'
    return ''
