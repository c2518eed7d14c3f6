"""Say how sure a figure is, by drawing runs (not queries, which are copies of their neighbours)."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

DRAWS = 1000


def pair_weights(
    pairs: Sequence[tuple[int, int]], draws: int = DRAWS, seed: int = 0
) -> NDArray[np.int64]:
    """Return how often [draws x P] each pair comes: as often as its two runs, drawn together.

    There are no rows with fewer than three runs: they are too few to say.
    """
    table = np.asarray(pairs, np.int64).reshape(-1, 2)
    runs, numbers = np.unique(table, return_inverse=True)
    if len(runs) < 3:
        return np.empty((0, len(table)), np.int64)
    numbers = numbers.reshape(-1, 2)
    share = np.full(len(runs), 1.0 / len(runs))
    drawn = np.random.default_rng(seed).multinomial(len(runs), share, size=draws)
    weights: NDArray[np.int64] = drawn[:, numbers[:, 0]] * drawn[:, numbers[:, 1]]
    return weights[weights.any(axis=1)]


def drawn_pairs(
    pairs: Sequence[tuple[int, int]], draws: int = DRAWS, seed: int = 0
) -> Iterator[NDArray[np.int64]]:
    """Yield numbers of pairs, each as often as `pair_weights` says."""
    for weights in pair_weights(pairs, draws, seed):
        yield np.repeat(np.arange(len(weights)), weights)


def interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float] | None:
    """Return the percentile interval of a figure of all draws; None where none has a value."""
    found = np.asarray(values, np.float64)
    found = found[np.isfinite(found)]
    if not len(found):
        return None
    low, high = np.quantile(found, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return float(low), float(high)


def mean_interval(
    pairs: Sequence[tuple[int, int]], values: NDArray[np.float64], draws: int = DRAWS
) -> tuple[float, float] | None:
    """Return the 95 % interval of the mean of a value [P] of each pair; NaN values do not count."""
    weights = pair_weights(pairs, draws) * np.isfinite(values)
    weights = weights[weights.any(axis=1)]
    return interval((weights @ np.nan_to_num(values) / weights.sum(axis=1)).tolist())
