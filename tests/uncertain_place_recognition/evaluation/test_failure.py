"""Figures of failure detection, against scikit-learn, brute force and closed forms."""

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, roc_auc_score, roc_curve

from lcd_common.errors import DataError
from uncertain_place_recognition.evaluation.failure import (
    auroc,
    average_precision,
    failure_detection,
    false_positive_rate,
    recall_at_precision,
    removal_curve,
    risk_coverage,
)


@pytest.fixture(params=['distinct', 'with ties'])
def judged(request):
    rng = np.random.default_rng(0)
    wrong = rng.random(800) < 0.2
    doubt = rng.normal(wrong * 1.2, 1.0)
    return (doubt if request.param == 'distinct' else np.round(doubt, 1)), wrong


def test_areas_agree_with_scikit_learn(judged):
    doubt, wrong = judged
    found = failure_detection(doubt, wrong)
    assert found.auroc == pytest.approx(roc_auc_score(wrong, doubt))
    assert found.aupr_out == pytest.approx(average_precision_score(wrong, doubt))
    assert found.aupr_in == pytest.approx(average_precision_score(~wrong, -doubt))
    assert found.base_rate == wrong.mean()


def test_false_positive_rate_agrees_with_scikit_learn(judged):
    doubt, wrong = judged
    # Positive: a right match that is accepted.
    fpr, tpr, _ = roc_curve(~wrong, -doubt, drop_intermediate=False)
    assert false_positive_rate(doubt, wrong) == pytest.approx(fpr[np.argmax(tpr >= 0.95)])


@pytest.mark.parametrize('precision', [0.9, 0.95, 0.99, 1.0])
def test_recall_at_a_precision_by_trying_every_threshold(judged, precision):
    doubt, wrong = judged
    best = 0.0
    for limit in doubt:
        accepted = doubt <= limit
        if (~wrong[accepted]).mean() >= precision:
            best = max(best, (~wrong & accepted).sum() / (~wrong).sum())
    assert recall_at_precision(doubt, wrong, precision) == pytest.approx(best)


def test_risk_and_removal_are_means_over_orders_of_equal_doubts():
    rng = np.random.default_rng(1)
    doubt, wrong = rng.integers(0, 3, 12).astype(float), rng.random(12) < 0.4
    risks, lefts = [], []
    for _ in range(4000):
        order = np.lexsort((rng.random(12), doubt))
        risks.append(np.cumsum(wrong[order]) / np.arange(1, 13))
        lefts.append([(~wrong[order])[:kept].mean() for kept in (12, 9, 6, 2)])
    assert risk_coverage(doubt, wrong)[1] == pytest.approx(np.mean(risks, 0), abs=0.02)
    found = removal_curve(doubt, ~wrong, [0.0, 0.25, 0.5, 0.9])
    assert found == pytest.approx(np.mean(lefts, 0), abs=0.02)


def test_area_under_risk_coverage_of_an_oracle_and_of_a_coin():
    wrong = np.arange(1000) < 300
    oracle = failure_detection(wrong.astype(float), wrong)
    # Closed form: errors only beyond coverage 0.7: integral of (c - 0.7) / c from 0.7 to 1.
    assert oracle.aurc == pytest.approx(0.3 + 0.7 * np.log(0.7), abs=1e-3)
    assert oracle.excess_aurc == pytest.approx(0.0, abs=1e-12)
    coin = failure_detection(np.zeros(1000), wrong)
    assert coin.aurc == pytest.approx(0.3)
    assert coin.auroc == 0.5


def test_a_perfect_and_a_reversed_doubt():
    wrong = np.array([False] * 6 + [True] * 4)
    perfect = failure_detection(np.arange(10.0), wrong)
    assert perfect.auroc == perfect.aupr_in == perfect.aupr_out == 1.0
    assert (perfect.fpr95, perfect.recall_at_p99, perfect.recall_at_p100) == (0.0, 1.0, 1.0)
    reversed_one = failure_detection(-np.arange(10.0), wrong)
    assert (reversed_one.auroc, reversed_one.fpr95, reversed_one.recall_at_p100) == (0.0, 1.0, 0.0)


def test_removal_reaches_all_when_the_doubt_is_an_oracle():
    right = np.arange(100) >= 25
    shares = np.arange(0.0, 0.95, 0.05)
    found = removal_curve(np.arange(100.0)[::-1], right, shares)
    assert found == pytest.approx(np.minimum(0.75 / (1.0 - shares), 1.0))
    assert removal_curve(np.ones(100), right, shares) == pytest.approx(0.75)
    assert removal_curve([3.0], [True], [0.9]) == [1.0], 'one query is always left'


def test_without_wrong_or_without_right_matches_there_is_nothing_to_tell():
    none_wrong = failure_detection(np.arange(5.0), np.zeros(5, bool))
    assert none_wrong.auroc is none_wrong.fpr95 is none_wrong.aupr_out is None
    assert (none_wrong.aurc, none_wrong.recall_at_p99) == (0.0, 1.0)
    all_wrong = failure_detection(np.arange(5.0), np.ones(5, bool))
    assert all_wrong.aupr_in is all_wrong.recall_at_p99 is None
    assert all_wrong.aurc == 1.0 and all_wrong.excess_aurc == 0.0


def test_infinite_doubt_is_the_most():
    assert auroc([0.0, 1.0, np.inf], [False, False, True]) == 1.0
    assert average_precision([0.0, 1.0, np.inf], [False, False, True]) == 1.0


def test_mistakes_are_named():
    with pytest.raises(DataError, match='at least one query'):
        failure_detection([], [])
    with pytest.raises(DataError, match='NaN'):
        failure_detection([np.nan], [True])
