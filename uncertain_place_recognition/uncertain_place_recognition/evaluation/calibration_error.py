"""Judge probabilities: of matches called wrong with probability p, a share of p should be wrong."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcd_common.errors import DataError


@dataclass(frozen=True)
class Reliability:
    """Predicted and observed rates of wrong matches, in bins of equally many queries.

    Attributes:
        predicted: [B] mean probability.
        observed: [B] share that is wrong.
        queries: [B] in each bin.
        ece: expected calibration error: mean |predicted - observed|, by queries.
        brier: mean squared difference of probability and outcome.
    """

    predicted: NDArray[np.float64]
    observed: NDArray[np.float64]
    queries: NDArray[np.int64]
    ece: float
    brier: float


def reliability(probability: ArrayLike, wrong: ArrayLike, bins: int = 15) -> Reliability:
    """Compare probabilities [N] with outcomes [N].

    Bins of equal width would leave most of them nearly empty where most matches are good.

    Raises:
        DataError: there is no query, or a probability is none.
    """
    p, w = np.asarray(probability, np.float64), np.asarray(wrong, bool)
    if p.shape != w.shape or p.ndim != 1 or not len(p):
        raise DataError(
            f'expected a probability and an outcome for each query, got the shapes {p.shape} and '
            f'{w.shape}'
        )
    if not ((p >= 0.0) & (p <= 1.0)).all():
        raise DataError('expected probabilities between 0 and 1')
    parts = np.array_split(np.argsort(p, kind='stable'), min(bins, len(p)))
    predicted = np.array([p[part].mean() for part in parts])
    observed = np.array([w[part].mean() for part in parts])
    queries = np.array([len(part) for part in parts], np.int64)
    ece = float((queries * np.abs(predicted - observed)).sum() / len(p))
    return Reliability(predicted, observed, queries, ece, float(np.square(p - w).mean()))
