"""See whether promised rates are kept: split the runs again and again, calibrate, and count."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError
from uncertain_place_recognition.acceptance import KINDS, Acceptance
from uncertain_place_recognition.calibration import choose_thresholds, split_runs
from uncertain_place_recognition.match_probability import MatchModel
from uncertain_place_recognition.query_table import QueryTable

TEST_SHARE = 1.0 / 3.0


@dataclass(frozen=True)
class Observed:
    """Rates on runs that neither the model nor the threshold had seen.

    Attributes:
        kind, target: of the acceptance.
        observed: mean of the rate that the kind promises over resplits that have one; None where
            none has. Nothing accepted is no precision, no wrong match no rate of false ones.
        low, high: 95 % interval of it over runs (bootstrap); None with fewer than three.
        exceeded: share of all resplits with more than the target; what accepts nothing keeps it.
        without: share of resplits in which no threshold could be given.
        empty: how many resplits have no rate, and are left out of observed and its interval.
        accepted_right: share of right matches that were accepted, mean over resplits.
        accepted: share of all matches that were accepted, mean over resplits.
        queries, no_match, wrong, runs: of all, not of one split.
        resplits: how many.
    """

    kind: str
    target: float
    observed: float | None
    low: float | None
    high: float | None
    exceeded: float
    without: float
    empty: int
    accepted_right: float
    accepted: float
    queries: int
    no_match: int
    wrong: int
    runs: int
    resplits: int

    def plain(self) -> dict[str, Any]:
        """Return the figures by name."""
        return asdict(self)


def observe(
    table: QueryTable,
    targets: Sequence[float],
    kinds: Sequence[str] = KINDS,
    resplits: int = 100,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Observed]:
    """Split runs into three, fit, choose thresholds and count on the third, many times.

    Args:
        table: queries of at least three runs.
        targets: rates.
        kinds: of acceptances.
        resplits: how many times.
        seed: of the splits.
        progress: told how many are done, of how many.

    Raises:
        DataError: there are fewer than three runs.
    """
    if len(table.runs) < 3:
        raise DataError(f'resplits need at least three runs with queries, got {len(table.runs)}')
    rng = np.random.default_rng(seed)
    names = [(kind, target) for kind in kinds for target in targets]
    counts = {name: _Counts(table) for name in names}
    for number in range(resplits):
        test_runs, others = split_runs(table, rng, TEST_SHARE)
        fit_runs, threshold_runs = split_runs(table.of_runs(others), rng, 0.5)
        fitted, held = table.of_runs(fit_runs), table.of_runs(threshold_runs)
        model = MatchModel.fit(fitted.features, fitted.wrong)
        rows = np.isin(table.run, test_runs)
        belief = model.belief(table.features[rows])
        for acceptance in choose_thresholds(model, fitted, held, targets, kinds):
            counts[acceptance.kind, acceptance.target].add(acceptance, rows, belief)
        progress(number + 1, resplits)
    return [counts[name].observed(*name) for name in names]


class _Counts:
    """Sums of one acceptance by resplit and run: for the mean, and for its interval over runs."""

    def __init__(self, table: QueryTable) -> None:
        self._table = table
        self._slot = {int(run): k for k, run in enumerate(table.runs)}
        self._by_run: list[NDArray[np.float64]] = []
        self._accepted: list[tuple[float, float]] = []
        self._missing: list[bool] = []

    def add(
        self, acceptance: Acceptance, rows: NDArray[np.bool_], belief: NDArray[np.float64]
    ) -> None:
        wrong, run = self._table.wrong[rows], self._table.run[rows]
        accepted = acceptance.accepts(belief)
        errors = accepted & wrong
        among = {'false_accepts': np.ones_like(wrong), 'precision': accepted}.get(
            acceptance.kind, wrong
        )
        slot = np.array([self._slot[int(number)] for number in run])
        sums = [np.bincount(slot, counted, len(self._slot)) for counted in (errors, among)]
        self._by_run.append(np.array(sums))
        right = max(int((~wrong).sum()), 1)
        self._accepted.append(((accepted & ~wrong).sum() / right, accepted.mean()))
        self._missing.append(acceptance.threshold is None)

    def observed(self, kind: str, target: float) -> Observed:
        table, number = self._table, len(self._slot)
        rates = self._rates(np.ones((1, number)))[0]
        has = np.isfinite(rates)
        low, high = self._interval()
        accepted_right, accepted = np.mean(self._accepted, axis=0)
        return Observed(
            kind, target, float(rates[has].mean()) if has.any() else None, low, high,
            float((rates[has] > target).sum() / len(rates)), float(np.mean(self._missing)),
            int((~has).sum()), float(accepted_right), float(accepted), len(table),
            int((~table.known).sum()), int(table.wrong.sum()), number, len(rates),
        )  # fmt: skip

    def _rates(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rate of every resplit [W x S] for weights of runs [W x R]; NaN without one."""
        errors, among = np.stack(self._by_run, axis=1)
        counted = weights @ among.T
        rates = np.full(counted.shape, np.nan)
        return np.divide(weights @ errors.T, counted, out=rates, where=counted > 0.0)

    def _interval(self, draws: int = 2000) -> tuple[float | None, float | None]:
        number = len(self._slot)
        if number < 3:
            return None, None
        rng = np.random.default_rng(0)
        drawn = rng.multinomial(number, np.full(number, 1.0 / number), size=draws)
        # Of the same mean that is observed: pooled rates would lie elsewhere where resplits differ.
        rates = self._rates(drawn.astype(float))
        rates = rates[np.isfinite(rates).any(axis=1)]
        if not len(rates):
            return None, None
        low, high = np.quantile(np.nanmean(rates, axis=1), [0.025, 0.975])
        return float(low), float(high)
