"""Judge a doubt: does it find wrong matches, and what must be given up to be rid of them.

`doubt` [N] is higher for worse matches, `wrong` [N] is the truth. Equal doubts are never told
apart: every figure is what it is on average over their orders, or takes them together.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata

from lcd_common.errors import DataError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FailureDetection:
    """How well a doubt finds wrong matches; None where there are no wrong, or no right ones.

    Attributes:
        queries: N.
        base_rate: share that is wrong: AuPR-out of a doubt that knows nothing; AuPR-in then has
            1 - base_rate.
        auroc: probability that a wrong match has more doubt than a right one.
        aupr_in: average precision, right ones being sought.
        aupr_out: average precision, wrong ones being sought.
        aurc: mean error of the n least doubted, over all n (risk-coverage curve).
        excess_aurc: `aurc` less that of an oracle.
        fpr95: share of wrong matches that are accepted when 95 % of the right ones are.
        recall_at_p99: largest share of right matches accepted with a precision of 99 %.
        recall_at_p100: the same without any error.
    """

    queries: int
    base_rate: float
    auroc: float | None
    aupr_in: float | None
    aupr_out: float | None
    aurc: float
    excess_aurc: float
    fpr95: float | None
    recall_at_p99: float | None
    recall_at_p100: float | None

    def plain(self) -> dict[str, Any]:
        """Return the figures by name."""
        return asdict(self)


def failure_detection(doubt: ArrayLike, wrong: ArrayLike) -> FailureDetection:
    """Judge a doubt [N] by all figures.

    Raises:
        DataError: there is nothing to judge, or the shapes do not fit.
    """
    d, w = _checked(doubt, wrong)
    both = bool(w.any() and not w.all())
    right = bool((~w).any())
    area = aurc(d, w)
    return FailureDetection(
        queries=len(w),
        base_rate=float(w.mean()),
        auroc=auroc(d, w) if both else None,
        aupr_in=average_precision(-d, ~w) if right else None,
        aupr_out=average_precision(d, w) if w.any() else None,
        aurc=area,
        excess_aurc=area - aurc(w, w),
        fpr95=false_positive_rate(d, w) if both else None,
        recall_at_p99=recall_at_precision(d, w, 0.99) if right else None,
        recall_at_p100=recall_at_precision(d, w, 1.0) if right else None,
    )


def auroc(doubt: ArrayLike, wrong: ArrayLike) -> float:
    """Return P(doubt of a wrong match > doubt of a right one), equal ones counting half."""
    d, w = _checked(doubt, wrong)
    rank = rankdata(d)
    positives, negatives = int(w.sum()), int((~w).sum())
    return float((rank[w].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def average_precision(score: ArrayLike, sought: ArrayLike) -> float:
    """Return the mean precision over thresholds, each by the recall it adds (no interpolation)."""
    s, y = _checked(score, sought)
    found, accepted = _counts(-s, y)
    gained = np.diff(np.concatenate([[0.0], found])) / found[-1]
    return float((gained * found / accepted).sum())


def aurc(doubt: ArrayLike, wrong: ArrayLike) -> float:
    """Return the area under the risk-coverage curve, 0 .. 1; less is better."""
    return float(risk_coverage(doubt, wrong)[1].mean())


def risk_coverage(doubt: ArrayLike, wrong: ArrayLike) -> tuple[Array, Array]:
    """Return coverages [N] (n/N) and the error of the n least doubted matches [N]."""
    errors = _expected_errors(*_checked(doubt, wrong))
    number = np.arange(1, len(errors) + 1)
    return number / len(errors), np.cumsum(errors) / number


def false_positive_rate(doubt: ArrayLike, wrong: ArrayLike, recall: float = 0.95) -> float:
    """Return the share of wrong matches accepted by the strictest threshold that keeps `recall`."""
    d, w = _checked(doubt, wrong)
    limit = np.quantile(d[~w], recall, method='inverted_cdf')
    return float((d[w] <= limit).mean())


def recall_at_precision(doubt: ArrayLike, wrong: ArrayLike, precision: float) -> float:
    """Return the largest share of right matches that a threshold accepts with this precision."""
    d, w = _checked(doubt, wrong)
    found, accepted = _counts(d, ~w)
    # 1e-12: 99 of 100 is 0.99, whatever doubles make of it.
    enough = found >= precision * accepted - 1e-12 * accepted
    return float(found[enough].max(initial=0.0) / found[-1])


def removal_curve(doubt: ArrayLike, right: ArrayLike, shares: ArrayLike) -> Array:
    """Return the share that is right [S] of what is left when the most doubted are removed.

    Args:
        doubt: [N].
        right: [N], e.g. whether one of the five best matches is.
        shares: [S] of queries removed, 0 .. 1; at least one query is left.
    """
    d, r = _checked(doubt, right)
    kept = np.cumsum(_expected_errors(d, r)) / np.arange(1, len(d) + 1)
    left = len(d) - np.floor(np.asarray(shares, np.float64) * len(d) + 1e-9).astype(int)
    return kept[np.maximum(left, 1) - 1]


def _counts(doubt: Array, sought: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return how many are sought, and how many there are, up to each distinct doubt."""
    order = np.argsort(doubt, kind='stable')
    last = np.concatenate([np.diff(doubt[order]) != 0.0, [True]])
    return (
        np.cumsum(sought[order], dtype=np.float64)[last],
        np.arange(1.0, len(doubt) + 1.0)[last],
    )


def _expected_errors(doubt: Array, wrong: NDArray[np.bool_]) -> Array:
    """Return wrong [N] in the order of doubt; equal doubts share the mean of theirs."""
    order = np.argsort(doubt, kind='stable')
    group = np.cumsum(np.concatenate([[0], np.diff(doubt[order]) != 0.0]))
    mean = np.bincount(group, wrong[order]) / np.bincount(group)
    return mean[group]


def _checked(values: ArrayLike, outcomes: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    v, o = np.asarray(values, np.float64), np.asarray(outcomes, bool)
    if v.shape != o.shape or v.ndim != 1 or not len(v):
        raise DataError(
            f'expected a value and an outcome for each of at least one query, got the shapes '
            f'{v.shape} and {o.shape}'
        )
    if np.isnan(v).any():
        raise DataError('expected numbers, got NaN among the doubts')
    return v, o
