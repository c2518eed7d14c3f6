"""What is said of promised rates where calibrations accept nothing."""

import numpy as np
import pytest

from uncertain_place_recognition import calibrate
from uncertain_place_recognition.acceptance import KINDS, available, needed
from uncertain_place_recognition.calibration import calibrate as calibrated_on
from uncertain_place_recognition.evaluation.guarantee import observe
from uncertain_place_recognition.query_table import QueryTable


def table_of(runs, queries, seed=0, trap=0.0):
    """Queries of which half are wrong; `trap` of the wrong ones look as good as the right ones."""
    rng = np.random.default_rng(seed)
    run = np.repeat(np.arange(runs), queries)
    wrong = rng.random(len(run)) < 0.5
    looks_wrong = wrong & (rng.random(len(run)) >= trap)
    features = np.exp(rng.normal(2.5 * looks_wrong[:, None], 0.7, (len(run), 4)))
    features[:, 3] /= 1.0 + features[:, 3]
    names = tuple(f'run_{k}' for k in range(runs))
    return QueryTable(features, wrong, ~wrong, run, names, 500, 'cosine')


def test_resplits_that_accept_nothing_have_no_precision():
    # About 250 queries choose a threshold: sometimes enough for 5 %, sometimes not.
    table = table_of(15, 50, seed=3, trap=0.03)
    one = observe(table, (0.05,), ('precision',), resplits=40)[0]
    assert 0 < one.empty < 40, 'some accept, some do not'
    assert one.without == pytest.approx(one.empty / 40, abs=0.051)
    # Before, each of these was a rate of 0, and the mean lay below the interval of the others.
    assert one.low <= one.observed <= one.high
    assert one.exceeded <= 1.0 - one.empty / 40


def test_the_mean_is_that_of_the_resplits_with_a_rate():
    table = table_of(15, 50, seed=3, trap=0.03)
    # The first n of the splits are the same, so sums tell what each one adds.
    found = [observe(table, (0.05,), ('precision',), resplits=n)[0] for n in range(1, 11)]
    empty = np.diff([0, *(one.empty for one in found)])
    sums = np.array([(one.observed or 0.0) * (one.resplits - one.empty) for one in found])
    added = np.diff(sums, prepend=0.0)
    assert 0 < empty.sum() < 10
    assert added[empty == 1] == pytest.approx(0.0)
    assert found[-1].observed == pytest.approx(added[empty == 0].mean())


def test_nothing_accepted_at_all_is_no_rate():
    one = observe(table_of(9, 10), (0.01,), ('precision',), resplits=5)[0]
    assert (one.observed, one.low, one.high) == (None, None, None)
    assert (one.empty, one.without, one.exceeded, one.accepted) == (5, 1.0, 0.0, 0.0)


def test_the_other_kinds_count_resplits_without_a_threshold_as_no_error():
    found = {one.kind: one for one in observe(table_of(9, 30), (0.05,), resplits=10)}
    by_run = found['false_match_rate_by_run']
    assert (by_run.observed, by_run.empty, by_run.without) == (0.0, 0, 1.0)
    assert found['false_match_rate'].empty == 0


def test_what_a_calibration_has_of_what_is_needed():
    belief = np.array([5.0, 4.0, 3.0, 2.0, 1.0, 0.0])
    wrong = np.array([False, False, True, False, True, True])
    run = np.array([0, 0, 0, 1, 1, 1])
    assert [available(kind, belief, wrong, run) for kind in KINDS] == [3, 2, 6, 2]
    assert available('precision', belief, np.zeros(6, bool), run) == 6
    # Just enough of each kind gives a threshold.
    assert needed('precision', 0.05) == 59 and needed('false_match_rate_by_run', 0.05) == 19


def test_a_promise_without_a_threshold_says_what_it_lacks():
    table = table_of(9, 10, trap=0.2)
    figures = calibrate._figures(calibrated_on(table, targets=(0.01, 0.05)), table)
    figures['resplits'] = [one.plain() for one in observe(table, (0.01,), resplits=3)]
    text = calibrate._text(figures)
    lines = [line for line in text.splitlines() if line.startswith('no threshold for')]
    missing = [one for one in figures['acceptances'] if one['threshold'] is None]
    assert len(lines) == len(missing) >= 4
    assert all(one['available'] < one['needed'] for one in missing)
    by_run = next(line for line in lines if 'by_run of 1 %' in line)
    assert 'needs at least 99 runs with wrong matches; there are 6 in the 6 runs' in by_run
    precision = next(line for line in lines if 'precision of 5 %' in line)
    assert '59 matches accepted without error' in precision
    assert ' -  ' in text, 'a rate that nobody observed is no number'
