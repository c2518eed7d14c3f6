"""Judge whether a filter is as wrong as it says (Bar-Shalom et al. 2001, chapter 5.4)."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from lcd_common import se3


def nees(T_map_body: se3.Array, covariance: se3.Array, T_map_body_true: se3.Array) -> float:
    """Return the normalised estimation error squared of a pose: chi-square of 6 when all is well.

    Args:
        T_map_body: estimate.
        covariance: its 6x6 in body axes (se3).
        T_map_body_true: truth.
    """
    xi = se3.log(se3.inverse(T_map_body) @ T_map_body_true)
    return float(xi @ np.linalg.solve(covariance, xi))


def anees_band(runs: int, degrees: int, probability: float = 0.95) -> tuple[float, float]:
    """Return where the mean NEES of independent runs lies with a probability."""
    tail = 0.5 * (1.0 - probability)
    low, high = chi2.ppf([tail, 1.0 - tail], runs * degrees) / runs
    return float(low), float(high)


@dataclass(frozen=True)
class Anees:
    """Consistency of a filter over epochs.

    Attributes:
        low, high: the band that 95 % of epochs should lie in.
        inside_share: share of epochs that do.
        mean: over everything; above the degrees the filter is too sure, below it is too shy.
    """

    low: float
    high: float
    inside_share: float
    mean: float


def anees(values: se3.Array, degrees: int = 6) -> Anees:
    """Sum up NEES values [runs x epochs]."""
    low, high = anees_band(len(values), degrees)
    mean = values.mean(axis=0)
    inside = (mean >= low) & (mean <= high)
    return Anees(low, high, float(inside.mean()), float(values.mean()))


def autocorrelation(whitened: list[se3.Array], lag: int = 1) -> float:
    """Return the correlation of innovations a lag apart, over sequences [n x m]; 0 is white.

    Args:
        whitened: innovations in units of their own covariance, one array for each run.
        lag: how many observations apart.
    """
    products = sum(float((w[lag:] * w[:-lag]).sum()) for w in whitened if len(w) > lag)
    squares = sum(float((w**2).sum()) * (1.0 - lag / len(w)) for w in whitened if len(w) > lag)
    return products / squares if squares else 0.0
