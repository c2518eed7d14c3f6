"""Thresholds by their definitions, and the rates they keep by simulation."""

import math

import numpy as np
import pytest
from scipy import stats

from lcd_common.errors import ConfigError, DataError, MapError
from uncertain_place_recognition.acceptance import (
    KINDS,
    Acceptance,
    belief_grid,
    false_accept_threshold,
    false_match_threshold,
    false_match_threshold_by_run,
    make_acceptance,
    needed,
    precision_threshold,
)


def draw(rng, number, share=0.15):
    """Gaussian beliefs, of which 15 % belong to wrong matches."""
    wrong = rng.random(number) < share
    return rng.normal(np.where(wrong, 0.0, 2.0), 1.0), wrong


def test_split_conformal_takes_the_order_statistic_of_its_definition():
    values = np.random.default_rng(0).permutation(np.arange(1.0, 200.0))  # 1 .. 199
    assert false_match_threshold(values, 0.05) == math.ceil(200 * 0.95) == 190.0
    assert false_match_threshold(values, 0.01) == 198.0
    assert false_match_threshold(values, 0.005) == 199.0
    assert false_match_threshold(values, 0.004) is None


@pytest.mark.parametrize(('target', 'least'), [(0.05, 19), (0.01, 99), (0.001, 999)])
def test_needs_of_the_average_guarantees(target, least):
    for kind in KINDS[:3]:
        assert needed(kind, target) == least
    values = np.arange(float(least))
    assert false_match_threshold(values, target) == least - 1
    assert false_match_threshold(values[1:], target) is None
    assert false_match_threshold_by_run(values, values, target) == least - 1
    assert false_match_threshold_by_run(values[1:], values[1:], target) is None
    right = np.zeros(least, bool)
    assert false_accept_threshold(values, right, target) < 0.0
    assert false_accept_threshold(values[1:], right[1:], target) is None


@pytest.mark.parametrize(('target', 'least'), [(0.05, 59), (0.01, 299), (0.001, 2995)])
def test_needs_of_the_precision_guarantee(target, least):
    assert needed('precision', target) == least
    for number, expected in ((least, 0.0), (least - 1, None)):
        right = np.zeros(number, bool)
        found = precision_threshold(np.ones(number), right, target, [0.0], starts=1)
        assert found == expected


def test_each_run_has_the_same_say_however_long_it_is():
    # 19 short runs with beliefs of 0, and a long one full of high ones.
    belief = np.concatenate([np.zeros(38), np.full(1000, 9.0)])
    run = np.concatenate([np.repeat(np.arange(19), 2), np.full(1000, 99)])
    # (1 + 1) / 21 > 0.05: the long run alone would break the target, its beliefs are not accepted.
    assert false_match_threshold_by_run(belief, run, 0.05) == 9.0
    # At 0.1 one run of 20 may be lost: (1 + 1) / 21 = 0.095.
    assert false_match_threshold_by_run(belief, run, 0.1) == 0.0


def test_by_run_with_one_query_a_run_is_split_conformal():
    values = np.random.default_rng(1).normal(size=150)
    for target in (0.01, 0.05, 0.3):
        expected = false_match_threshold(values, target)
        assert false_match_threshold_by_run(values, np.arange(150), target) == expected


def test_by_run_against_its_definition():
    rng = np.random.default_rng(2)
    run = np.sort(rng.integers(0, 30, 400))
    values = np.round(rng.normal(size=400), 1)
    for target in (0.04, 0.1, 0.5):
        found = false_match_threshold_by_run(values, run, target)

        def bound(t):
            shares = [np.mean(values[run == r] > t) for r in np.unique(run)]
            return (1.0 + sum(shares)) / (len(np.unique(run)) + 1)

        lower = values[values < found]
        assert bound(found) <= target + 1e-9 < bound(lower.max())


def test_risk_control_against_its_definition():
    rng = np.random.default_rng(3)
    belief, wrong = draw(rng, 777)
    for target in (0.01, 0.05):
        found = false_accept_threshold(belief, wrong, target)

        def bound(t):
            return (np.sum((belief > t) & wrong) + 1) / (len(belief) + 1)

        assert bound(found) <= target < bound(np.nextafter(found, -np.inf))


def test_precision_uses_exact_binomial_tests_from_strict_to_loose():
    rng = np.random.default_rng(4)
    belief, wrong = draw(rng, 3000)
    grid = np.linspace(-2, 5, 60)
    found = precision_threshold(belief, wrong, 0.05, grid, starts=1)
    # One start at the strictest, which accepts too few: nothing can be proven.
    assert found is None
    grid = grid[grid < 2.5]
    found = precision_threshold(belief, wrong, 0.05, grid, starts=1)
    for t in sorted(grid, reverse=True):
        accepted = belief > t
        test = stats.binomtest(
            int(wrong[accepted].sum()), int(accepted.sum()), 0.05, alternative='less'
        )
        if test.pvalue > 0.05:
            assert t < found
            break
        assert t >= found


def test_the_measured_anchors_hold():
    """15 % wrong, 2000 queries, target 1 %: rates known from an earlier, independent simulation."""
    rng = np.random.default_rng(5)
    rates = {kind: [] for kind in KINDS}
    for _ in range(300):
        belief, wrong = draw(rng, 2000)
        run, pilot = np.arange(2000), draw(rng, 2000)
        for kind in KINDS:
            found = make_acceptance(kind, 0.01, belief, wrong, run, 1000, pilot=pilot)
            t = found.threshold
            if t is None:
                rates[kind].append(0.0)
                continue
            # The true rates are known in closed form.
            false, true = stats.norm.sf(t, 0.0), stats.norm.sf(t, 2.0)
            accepted = 0.15 * false + 0.85 * true
            rates[kind].append(
                {'false_accepts': 0.15 * false, 'precision': 0.15 * false / accepted}.get(
                    kind, false
                )
            )
    assert np.mean(rates['false_match_rate']) == pytest.approx(0.0088, abs=0.0015)
    assert np.mean(rates['false_accepts']) == pytest.approx(0.0101, abs=0.001)
    assert np.mean(rates['precision']) == pytest.approx(0.0033, abs=0.0025)
    assert np.mean(np.array(rates['precision']) > 0.01) <= 0.05
    # On average, not for every calibration: that is what the documentation warns of.
    assert 0.2 < np.mean(np.array(rates['false_match_rate']) > 0.01) < 0.45


def test_by_run_keeps_the_target_where_runs_differ_and_queries_alone_do_not():
    rng = np.random.default_rng(6)
    rates = {'false_match_rate': [], 'false_match_rate_by_run': []}
    for _ in range(300):
        offsets = rng.normal(0, 1.0, 25)
        run = np.repeat(np.arange(24), 60)
        belief = offsets[run] + rng.normal(0, 0.3, len(run))
        for kind, found in rates.items():
            t = make_acceptance(kind, 0.05, belief, np.ones(len(run)), run, 10).threshold
            found.append(stats.norm.sf(t, offsets[24], 0.3))
    assert np.mean(rates['false_match_rate_by_run']) < 0.05
    assert np.mean(rates['false_match_rate']) > 0.055, 'pooling forgets that runs differ'


def test_an_acceptance_says_what_it_rests_on():
    belief, wrong = draw(np.random.default_rng(7), 500)
    found = make_acceptance('precision', 0.05, belief, wrong, np.arange(500) // 50, 1234)
    assert (found.queries, found.wrong, found.runs) == (500, wrong.sum(), 10)
    assert found.confidence == 0.95
    assert Acceptance.from_plain(found.plain()) == found
    assert found.accepts(found.threshold) == np.False_
    assert found.accepts([found.threshold + 1e-9]).tolist() == [True]
    assert found.covers(1300) and not found.covers(1400)


def test_too_few_queries_accept_nothing():
    found = make_acceptance('false_match_rate', 0.01, np.ones(5), np.ones(5), np.arange(5), 10)
    assert found.threshold is None
    assert not found.accepts([1e9, np.inf]).any()


def test_the_grid_does_not_depend_on_data():
    grid = belief_grid()
    p_wrong = 1.0 / (1.0 + np.exp(grid))
    assert (p_wrong.min(), p_wrong.max()) == pytest.approx((1e-5, 0.7))


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match='one of false_match_rate'):
        make_acceptance('trust', 0.01, [1.0], [True], [0], 1)
    with pytest.raises(ConfigError, match='between 0 and 1'):
        false_match_threshold([1.0], 1.0)
    with pytest.raises(DataError, match='for every query'):
        make_acceptance('precision', 0.01, [1.0, 2.0], [True], [0], 1)
    with pytest.raises(MapError, match='no acceptance'):
        Acceptance.from_plain({'kind': 'precision'})
