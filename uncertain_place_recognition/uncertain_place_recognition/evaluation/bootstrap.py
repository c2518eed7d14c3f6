"""Say how sure a figure is, by drawing runs (not queries, which are copies of their neighbours)."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

DRAWS = 1000


def drawn_pairs(
    pairs: Sequence[tuple[int, int]], draws: int = DRAWS, seed: int = 0
) -> Iterator[NDArray[np.int64]]:
    """Yield numbers [P] of pairs, each as often as its two runs were drawn together.

    Nothing comes of fewer than three runs: they are too few to say.
    """
    table = np.asarray(pairs, np.int64).reshape(-1, 2)
    runs, numbers = np.unique(table, return_inverse=True)
    if len(runs) < 3:
        return
    numbers = numbers.reshape(-1, 2)
    rng = np.random.default_rng(seed)
    for _ in range(draws):
        drawn = rng.multinomial(len(runs), np.full(len(runs), 1.0 / len(runs)))
        chosen = np.repeat(np.arange(len(numbers)), drawn[numbers].prod(axis=1))
        if len(chosen):
            yield chosen


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
    counts = np.isfinite(values)
    clean = np.where(counts, values, 0.0)
    return interval(
        [
            clean[chosen].sum() / counts[chosen].sum()
            for chosen in drawn_pairs(pairs, draws)
            if counts[chosen].any()
        ]
    )
