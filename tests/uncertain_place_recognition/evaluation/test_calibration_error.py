import numpy as np
import pytest
from sklearn.metrics import brier_score_loss

from lcd_common.errors import DataError
from uncertain_place_recognition.evaluation.calibration_error import reliability


def test_true_probabilities_have_almost_no_error():
    rng = np.random.default_rng(0)
    p = rng.beta(0.5, 2.0, 50_000)
    wrong = rng.random(50_000) < p
    found = reliability(p, wrong)
    assert found.ece < 0.01
    assert found.brier == pytest.approx(brier_score_loss(wrong, p))


def test_a_constant_offset_is_the_error():
    rng = np.random.default_rng(1)
    p = rng.uniform(0.2, 0.6, 50_000)
    found = reliability(p + 0.3, rng.random(50_000) < p)
    assert found.ece == pytest.approx(0.3, abs=0.01)


def test_bins_hold_equally_many():
    found = reliability(np.linspace(0, 1, 103) ** 4, np.zeros(103, bool), bins=10)
    assert found.queries.sum() == 103 and np.ptp(found.queries) <= 1
    by_hand = np.mean(np.linspace(0, 1, 103) ** 4)
    assert found.ece == pytest.approx(by_hand)


def test_a_single_query_and_mistakes():
    assert reliability([0.25], [True]).ece == 0.75
    with pytest.raises(DataError, match='between 0 and 1'):
        reliability([1.5], [True])
    with pytest.raises(DataError, match='for each query'):
        reliability([], [])
