"""Check the measures on distributions whose answer is known (values: 4000 draws, docs)."""

import numpy as np
import pytest
from scipy import stats

from cmrnet_ekf.calibration import (
    ause,
    calibration,
    calibration_curve,
    sharpness,
    sparsification,
)
from cmrnet_ekf.pose_belief import PoseBelief
from lcd_common.errors import DataError

INF = float('inf')


def mace(errors, scale, freedom=INF):
    return calibration_curve(errors, np.full(len(errors), scale), freedom).mean_error


@pytest.mark.parametrize(
    ('factor', 'expected'), [(1.0, 0.005), (0.5, 0.209), (0.8, 0.075), (1.25, 0.066), (2.0, 0.201)]
)
def test_gaussians_with_wrong_scales(factor, expected):
    errors = np.random.default_rng(0).normal(size=40000)
    assert mace(errors, factor) == pytest.approx(expected, abs=0.006)


@pytest.mark.parametrize(
    ('freedom', 'as_gaussian'), [(2.5, 0.162), (3, 0.108), (5, 0.047), (10, 0.014), (30, 0.011)]
)
def test_a_student_t_law_is_right_as_itself_and_not_as_a_gaussian(freedom, as_gaussian):
    errors = stats.t.rvs(freedom, size=40000, random_state=1)
    assert mace(errors, 1.0, freedom) < 0.006
    variance = freedom / (freedom - 2.0)
    assert mace(errors, np.sqrt(variance)) == pytest.approx(as_gaussian, abs=0.012)


def test_the_curve_of_a_wrong_scale_is_the_known_function():
    errors = np.random.default_rng(2).normal(size=200000)
    curve = calibration_curve(errors, np.full(len(errors), 0.5), INF)
    expected = 1 - 2 * stats.norm.sf(0.5 * stats.norm.ppf(0.5 + curve.expected / 2))
    np.testing.assert_allclose(curve.observed, expected, atol=0.005)


def test_each_row_may_have_its_own_law():
    rng = np.random.default_rng(3)
    freedom = np.where(rng.random(20000) < 0.5, 3.0, np.inf)
    scale = rng.uniform(0.1, 5.0, 20000)
    draws = np.where(np.isinf(freedom), rng.normal(size=20000), rng.standard_t(3, 20000))
    assert calibration_curve(draws * scale, scale, freedom).mean_error < 0.01


@pytest.mark.parametrize('scale', [0.0, -1.0, np.nan])
def test_scales_that_are_none_are_refused(scale):
    with pytest.raises(DataError, match='positive'):
        mace(np.ones(3), scale)


def belief(scale, freedom=INF, mean=None):
    mean = np.zeros_like(scale) if mean is None else mean
    return PoseBelief(mean, scale, np.full_like(scale, freedom), np.square(scale))


def test_components_are_judged_apart_and_angles_wrap():
    rng = np.random.default_rng(4)
    scale = np.full((20000, 6), 0.1)
    mean = np.zeros((20000, 6))
    mean[:, 5] = np.pi - 0.01
    target = mean + rng.normal(size=mean.shape) * scale * [1, 2, 1, 1, 1, 1]
    target[:, 5] = np.mod(target[:, 5] + np.pi, 2 * np.pi) - np.pi
    curves = calibration(belief(scale, mean=mean), target)
    assert curves['y'].mean_error == pytest.approx(0.209, abs=0.006)
    assert all(curves[axis].mean_error < 0.01 for axis in ('x', 'z', 'roll', 'pitch', 'yaw'))


def test_sharpness_is_the_predictive_deviation():
    np.testing.assert_allclose(sharpness(belief(np.full((10, 6), 2.0))), 2.0)
    heavy = belief(np.full((10, 6), 2.0), freedom=4.0)
    np.testing.assert_allclose(sharpness(heavy), 2.0 * np.sqrt(2.0))
    assert np.isinf(belief(np.ones((1, 6)), freedom=2.0).variance).all()


def test_sparsification_discards_the_most_uncertain():
    errors = np.array([1.0, 2.0, 3.0, 4.0])
    left = sparsification(errors, errors, np.array([0.0, 0.25, 0.5, 0.75]))
    np.testing.assert_allclose(left, [2.5, 2.0, 1.5, 1.0])


def test_ause_is_nothing_for_a_perfect_order_and_large_for_the_reverse():
    errors = np.random.default_rng(5).exponential(size=20000)
    assert ause(errors, errors) == 0.0
    useless = ause(errors, np.random.default_rng(6).random(20000))
    # Exponential errors: kept at random 1, kept by the error 1 + x log(x) / (1 - x) over shares x.
    x = np.linspace(1e-6, 0.99, 100000)
    known = np.trapezoid(-x * np.log(x) / (1 - x), x)
    assert useless == pytest.approx(known, abs=0.02)
    assert ause(errors, -errors) > useless
