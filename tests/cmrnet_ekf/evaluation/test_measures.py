"""The figures of the tables, recomputed by hand from raw errors."""

import numpy as np
import pytest
from evaluation_cases import known_answers, perfect_answers
from scipy import stats
from scipy.spatial.transform import Rotation

from cmrnet_ekf.evaluation import measures
from cmrnet_ekf.evaluation.answers import Answers
from cmrnet_ekf.pose_belief import gaussian_of_samples


def test_a_perfect_method_has_no_error_and_does_not_know():
    answers = perfect_answers()
    errors = answers.summary()
    assert errors.t_mean_m < 1e-12 and errors.r_p95_deg < 1e-5
    assert errors.failures_1m == 0.0 and not answers.knows


def test_errors_are_those_of_poses_not_of_components():
    answers = known_answers(200)
    metres = np.linalg.norm((answers.target - answers.belief.mean)[:, :3], axis=1)
    one, other = (
        Rotation.from_euler('xyz', c[:, 3:]) for c in (answers.target, answers.belief.mean)
    )
    degrees = np.rad2deg((one.inv() * other).magnitude())
    errors = answers.summary()
    assert errors.t_mean_m == pytest.approx(metres.mean())
    assert errors.t_p95_m == pytest.approx(np.percentile(metres, 95))
    assert errors.r_median_deg == pytest.approx(np.median(degrees))
    assert errors.failures_1m == pytest.approx((metres > 1.0).mean())


@pytest.mark.parametrize('freedom', [np.inf, 3.0])
def test_a_right_law_is_calibrated_as_what_it_is(freedom):
    known = measures.of_uncertainty(known_answers(20000, freedom=freedom))
    assert max(known['calibration'].values()) < 0.01


def test_half_the_scale_has_the_known_calibration_error():
    known = measures.of_uncertainty(known_answers(20000, told=0.5))
    # |erf-like curve - diagonal| averaged over the levels, for a Gaussian told half its deviation.
    levels = np.linspace(0.01, 0.99, 99)
    observed = 1 - 2 * stats.norm.sf(0.5 * stats.norm.ppf(0.5 + levels / 2))
    for value in known['calibration'].values():
        assert value == pytest.approx(np.abs(observed - levels).mean(), abs=0.012)


def test_rejection_is_by_either_trace():
    answers = known_answers(1000)
    variance = np.square(answers.belief.scale)
    of = variance[:, :3].sum(1), variance[:, 3:].sum(1)
    top = np.zeros(1000, bool)
    for trace in of:
        top[np.argsort(trace)[850:]] = True
    found = measures.after_rejection(answers)
    metres = np.linalg.norm((answers.target - answers.belief.mean)[:, :3], axis=1)
    assert found['discarded_share'] == pytest.approx(top.mean())
    assert found['t_mean_m'] == pytest.approx(metres[~top].mean())
    assert found['count'] == (~top).sum()
    # As map_registration compares: above these is rejected.
    limits = found['max_trace_translation'], found['max_trace_rotation']
    above = (of[0] > limits[0]) | (of[1] > limits[1])
    np.testing.assert_array_equal(above, top)
    assert found['t_mean_m'] < metres.mean(), 'larger scales, larger errors'
    curve = measures.by_confidence(answers)
    assert curve['t_mean_m'][0] == pytest.approx(metres.mean())
    assert curve['t_mean_m'][-1] < curve['t_mean_m'][0]


def drawn(kind: str, count: int) -> Answers:
    rng = np.random.default_rng(3)
    target = rng.uniform(-0.1, 0.1, (40, 6))
    draws = target + rng.normal(0, 0.05, (count, 40, 6))
    return Answers(kind, gaussian_of_samples(draws.copy()), target, draws)


def test_counts_of_an_ensemble_are_means_over_its_members():
    answers = drawn('de', 3)
    found = measures.by_count(answers)
    assert list(found) == ['2', '3']
    pairs = [(0, 1), (1, 2), (2, 0)]
    means = [
        np.linalg.norm((answers.draws[list(p)].mean(0) - answers.target)[:, :3], axis=1).mean()
        for p in pairs
    ]
    assert found['2']['t_mean_m'] == pytest.approx(np.mean(means))
    assert found['3']['t_mean_m'] == pytest.approx(answers.summary().t_mean_m)


def test_counts_of_dropout_take_the_first_draws():
    answers = drawn('mcd', 12)
    found = measures.by_count(answers)
    assert list(found) == ['2', '3', '5', '10']
    metres = np.linalg.norm((answers.draws[:5].mean(0) - answers.target)[:, :3], axis=1)
    assert found['5']['t_median_m'] == pytest.approx(np.median(metres))
    assert found['10']['t_mean_m'] < found['2']['t_mean_m']
