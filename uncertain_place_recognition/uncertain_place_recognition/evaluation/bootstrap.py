"""Say how sure a figure is, by drawing runs (not queries, which are copies of their neighbours)."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

DRAWS = 1000


def interval_over_runs(
    pairs: Sequence[tuple[int, int]],
    statistic: Callable[[NDArray[np.int64]], float],
    level: float = 0.95,
    draws: int = DRAWS,
    seed: int = 0,
) -> tuple[float, float] | None:
    """Return the percentile interval of a statistic when runs are drawn with replacement.

    Args:
        pairs: (database, queries) numbers of runs.
        statistic: of the chosen pairs: it gets numbers [P] of pairs, each as often as its two runs
            were drawn together; NaN where it has no value.
        level: of the interval.
        draws: how many.
        seed: of the draws.

    Returns:
        Low and high; None with fewer than three runs, which are too few to say.
    """
    table = np.asarray(pairs, np.int64).reshape(-1, 2)
    runs, numbers = np.unique(table, return_inverse=True)
    if len(runs) < 3:
        return None
    numbers = numbers.reshape(-1, 2)
    rng = np.random.default_rng(seed)
    found: list[float] = []
    for _ in range(draws):
        drawn = rng.multinomial(len(runs), np.full(len(runs), 1.0 / len(runs)))
        chosen = np.repeat(np.arange(len(numbers)), drawn[numbers].prod(axis=1))
        if len(chosen):
            found.append(float(statistic(chosen)))
    values = np.array(found)
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = np.quantile(values, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return float(low), float(high)


def mean_interval(
    pairs: Sequence[tuple[int, int]], values: NDArray[np.float64], draws: int = DRAWS
) -> tuple[float, float] | None:
    """Return the interval of the mean of a value [P] of each pair; NaN values do not count."""

    def mean(chosen: NDArray[np.int64]) -> float:
        part = values[chosen]
        part = part[np.isfinite(part)]
        return float(part.mean()) if len(part) else float('nan')

    return interval_over_runs(pairs, mean, draws=draws)
