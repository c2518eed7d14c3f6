"""Choose from which belief on a match is accepted, so that a stated rate of errors is kept.

A belief is any number that is higher for better matches (`MatchModel.belief`); a match is accepted
when it lies above the threshold. All guarantees need calibration queries that are exchangeable with
those in use: of other runs of the same kind of environment and sensor, searched in a map of about
the same size. Neighbouring submaps are nearly copies of one another, so runs are the unit.

Four rules (n calibration queries, target a, confidence 1 - d):

`false_match_rate`: P(accepted | wrong) <= a, on average over calibrations, by split conformal
prediction (Vovk et al. 2005). Needs ceil(1/a) - 1 wrong matches: 19 / 99 for 5 % / 1 %.
`false_match_rate` by run: the same for a query of a new run, where runs rather than queries are
exchangeable, by hierarchical conformal prediction (Lee, Barber, Willett 2023). Needs as many runs.
`false_accepts`: P(accepted and wrong) <= a, on average, by conformal risk control (Angelopoulos et
al. 2024). Needs ceil(1/a) - 1 queries. It says little where wrong matches are rare.
`precision`: P(wrong | accepted) <= a with confidence 1 - d for this very calibration, by Learn Then
Test (Angelopoulos et al. 2021). Needs ceil(ln d / ln(1 - a)) accepted ones without any error: 59 /
299 at 5 % / 1 % and d = 5 %. Its binomial test takes queries for independent.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binom

from lcd_common.errors import ConfigError, DataError, MapError

KINDS = ('false_match_rate', 'false_match_rate_by_run', 'false_accepts', 'precision')
# Beyond this growth of the map an acceptance says nothing: more places, more that look alike.
GROWTH = 1.1
_STARTS = 5


@dataclass(frozen=True)
class Acceptance:
    """A threshold, what it promises, and on what that rests.

    Attributes:
        kind: one of KINDS.
        target: the rate that is kept, 0 .. 1.
        confidence: that it is kept by this calibration; None: it is kept on average over them.
        threshold: beliefs above it are accepted; None: none is, because the calibration has too
            few queries or too many errors for this target.
        queries: of the calibration.
        wrong: of these, matches that are wrong.
        runs: that the queries come from.
        database_size: entries that were searched.
    """

    kind: str
    target: float
    confidence: float | None
    threshold: float | None
    queries: int
    wrong: int
    runs: int
    database_size: int

    def accepts(self, belief: ArrayLike) -> NDArray[np.bool_]:
        """Tell [...] which beliefs [...] are high enough."""
        values = np.asarray(belief, np.float64)
        if self.threshold is None:
            return np.zeros(values.shape, bool)
        return values > self.threshold

    def covers(self, database_size: int) -> bool:
        """Tell whether a map is small enough for what was promised; it may grow by a tenth."""
        return database_size <= GROWTH * self.database_size

    def plain(self) -> dict[str, Any]:
        """Return the acceptance as JSON has it."""
        return asdict(self)

    @staticmethod
    def from_plain(plain: Mapping[str, Any]) -> 'Acceptance':
        """Return what `plain` gave; raises MapError when it is none."""
        try:
            acceptance = Acceptance(**plain)
        except TypeError as error:
            raise MapError(f'no acceptance: {error}') from None
        if acceptance.kind not in KINDS:
            raise MapError(f'no acceptance of the kind {acceptance.kind!r}')
        return acceptance


def make_acceptance(
    kind: str,
    target: float,
    belief: ArrayLike,
    wrong: ArrayLike,
    run: ArrayLike,
    database_size: int,
    confidence: float = 0.95,
    pilot: tuple[ArrayLike, ArrayLike] | None = None,
) -> Acceptance:
    """Choose the threshold of a kind from the queries of calibration runs.

    Args:
        kind: one of KINDS.
        target: rate to keep.
        belief: [N] of the matches.
        wrong: [N] whether they are.
        run: [N] names or numbers of the runs they come from.
        database_size: entries that were searched.
        confidence: of `precision` alone.
        pilot: of `precision` alone: beliefs [P] and outcomes [P] of other queries, from which it
            learns where to begin; without, it begins at several places and proves less.

    Raises:
        ConfigError: the kind is unknown, or a rate is not between 0 and 1.
        DataError: the arrays do not fit together.
    """
    values, errors, runs = np.asarray(belief, np.float64), np.asarray(wrong, bool), np.asarray(run)
    if values.ndim != 1 or not values.shape == errors.shape == runs.shape:
        raise DataError(
            f'expected a belief, an outcome and a run for every query, got the shapes '
            f'{values.shape}, {errors.shape} and {runs.shape}'
        )
    if kind == 'false_match_rate':
        found = false_match_threshold(values[errors], target)
    elif kind == 'false_match_rate_by_run':
        found = false_match_threshold_by_run(values[errors], runs[errors], target)
    elif kind == 'false_accepts':
        found = false_accept_threshold(values, errors, target)
    elif kind == 'precision':
        grid, starts = belief_grid(), _STARTS
        if pilot is not None:
            grid, starts = pilot_grid(*pilot, target), 1
        found = precision_threshold(values, errors, target, grid, confidence, starts)
    else:
        raise ConfigError(f'an acceptance must be one of {", ".join(KINDS)}, got {kind!r}')
    return Acceptance(
        kind, float(target), confidence if kind == 'precision' else None, found, len(values),
        int(errors.sum()), len(np.unique(runs)), int(database_size),
    )  # fmt: skip


def false_match_threshold(wrong_belief: ArrayLike, target: float) -> float | None:
    """Return the threshold that accepts a wrong match at most at the target rate.

    It is the ceil((n + 1)(1 - a))-th smallest belief of n wrong matches; None where n is too small.
    """
    values, a = np.sort(np.asarray(wrong_belief, np.float64)), _rate(target)
    # 1e-9: (n + 1)(1 - a) that is whole must not be rounded up.
    rank = math.ceil((len(values) + 1) * (1.0 - a) - 1e-9)
    return float(values[rank - 1]) if rank <= len(values) else None


def false_match_threshold_by_run(
    wrong_belief: ArrayLike, run: ArrayLike, target: float
) -> float | None:
    """Return the same threshold for a query of a new run; every run has the same say.

    The least t for which (1 + sum over K runs of the share of its beliefs above t) / (K + 1) <= a.
    """
    values, a = np.asarray(wrong_belief, np.float64), _rate(target)
    _, group, count = np.unique(np.asarray(run), return_inverse=True, return_counts=True)
    budget = a * (len(count) + 1) - 1.0
    if budget < -1e-9:
        return None
    order = np.argsort(-values, kind='stable')
    above = np.concatenate([[0.0], np.cumsum(1.0 / count[group[order]])])
    # With the k-th highest as the threshold, those before it (and not equal to it) are accepted.
    first = np.searchsorted(-values[order], -values[order], side='left')
    kept = np.flatnonzero(above[first] <= budget + 1e-9)
    return float(values[order[kept[-1]]]) if len(kept) else None


def false_accept_threshold(belief: ArrayLike, wrong: ArrayLike, target: float) -> float | None:
    """Return the least threshold for which (wrong accepted + 1) / (n + 1) <= a; None if none."""
    values, errors, a = np.asarray(belief, np.float64), np.asarray(wrong, bool), _rate(target)
    allowed = math.floor(a * (len(values) + 1) - 1.0 + 1e-9)
    if allowed < 0:
        return None
    worst = -np.sort(-values[errors])
    if allowed >= len(worst):
        return float(np.nextafter(values.min(), -np.inf))
    return float(worst[allowed])


def precision_threshold(
    belief: ArrayLike,
    wrong: ArrayLike,
    target: float,
    grid: ArrayLike,
    confidence: float = 0.95,
    starts: int = _STARTS,
) -> float | None:
    """Return the loosest threshold whose accepted matches are proven right often enough.

    Thresholds are tested from strict to loose by exact binomial p-values. A strict one accepts too
    few to prove anything, so the sequence starts at several places, each with its share of the
    error probability, and goes on while it proves (fixed sequence with multiple starts).

    Args:
        belief: [N].
        wrong: [N].
        target: share of wrong ones among those accepted.
        grid: thresholds to test; they must not be chosen by looking at these queries.
        confidence: that the share is kept.
        starts: where sequences start, evenly over the grid.
    """
    values, errors, a = np.asarray(belief, np.float64), np.asarray(wrong, bool), _rate(target)
    thresholds = -np.sort(-np.unique(np.asarray(grid, np.float64)))
    p_value = _binomial(values, errors, thresholds, a)
    begin = np.unique(np.linspace(0, len(thresholds), starts, endpoint=False).astype(int))
    proven = p_value <= (1.0 - _rate(confidence)) / len(begin)
    loosest = -1
    for first in begin:
        stop = np.flatnonzero(~proven[first:])
        last = first + (stop[0] if len(stop) else len(thresholds) - first) - 1
        loosest = max(loosest, last if last >= first else -1)
    return float(thresholds[loosest]) if loosest >= 0 else None


def belief_grid() -> NDArray[np.float64]:
    """Return thresholds of belief fixed for ever: probabilities of 1e-5 to 0.7 to be wrong."""
    return np.linspace(math.log((1 - 0.7) / 0.7), math.log((1 - 1e-5) / 1e-5), 200)


def pilot_grid(belief: ArrayLike, wrong: ArrayLike, target: float) -> NDArray[np.float64]:
    """Return thresholds that begin where other queries [P] prove the target best, downwards."""
    values, errors = np.asarray(belief, np.float64), np.asarray(wrong, bool)
    thresholds = np.quantile(values, np.linspace(0.0, 1.0, 201)[:-1])
    p_value = _binomial(values, errors, thresholds, _rate(target))
    return thresholds[: int(np.argmin(p_value)) + 1]


def needed(kind: str, target: float, confidence: float = 0.95) -> int:
    """Return what a kind needs at least: wrong matches, runs, queries, or accepted ones."""
    a = _rate(target)
    if kind == 'precision':
        return math.ceil(math.log(1.0 - _rate(confidence)) / math.log(1.0 - a) - 1e-9)
    return math.ceil(1.0 / a - 1e-9) - 1


def available(kind: str, belief: ArrayLike, wrong: ArrayLike, run: ArrayLike) -> int:
    """Return how many of what `needed` counts the queries [N] of a calibration have.

    Of `precision` these are the right matches above the most believed wrong one: what a threshold
    can accept without any error.
    """
    values, errors = np.asarray(belief, np.float64), np.asarray(wrong, bool)
    if kind == 'false_match_rate':
        return int(errors.sum())
    if kind == 'false_match_rate_by_run':
        return len(np.unique(np.asarray(run)[errors]))
    if kind == 'false_accepts':
        return len(values)
    return int((values > values[errors].max(initial=-np.inf)).sum())


def _binomial(
    values: NDArray[np.float64],
    errors: NDArray[np.bool_],
    thresholds: NDArray[np.float64],
    a: float,
) -> NDArray[np.float64]:
    """Return the p-value of each threshold: so few errors, if their rate were above a."""
    accepted = len(values) - np.searchsorted(np.sort(values), thresholds, side='right')
    failed = errors.sum() - np.searchsorted(np.sort(values[errors]), thresholds, side='right')
    found: NDArray[np.float64] = binom.cdf(failed, accepted, a)
    return found


def _rate(value: float) -> float:
    if not 0.0 < value < 1.0:
        raise ConfigError(f'a rate must lie between 0 and 1, got {value:g}')
    return value
