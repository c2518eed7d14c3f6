import json
from itertools import pairwise

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from lcd_common.errors import DataError, MapError
from uncertain_place_recognition.match_probability import FEATURES, MatchFeatures, MatchModel


def queries(number, seed):
    """Features with heavy tails and other units, of which the third says nothing."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(number, 4))
    wrong = rng.random(number) < 1.0 / (1.0 + np.exp(1.0 - 1.5 * z[:, 0] - 0.8 * z[:, 1]))
    rows = np.column_stack(
        [np.exp(z[:, 0]), 1e-3 * np.exp(2.0 * z[:, 1]), 500.0 * np.exp(z[:, 2]), z[:, 3] ** 3]
    )
    return rows, wrong, z


@pytest.fixture(scope='module')
def model():
    rows, wrong, _ = queries(4000, 0)
    return MatchModel.fit(rows, wrong)


def test_probabilities_are_the_shares_that_are_wrong(model):
    rows, wrong, _ = queries(20_000, 1)
    p = model.false_match_probability(rows)
    edges = np.quantile(p, np.linspace(0, 1, 11))
    for low, high in pairwise(edges):
        inside = (p >= low) & (p <= high)
        assert p[inside].mean() == pytest.approx(wrong[inside].mean(), abs=0.045)


def test_it_tells_as_much_as_a_regression_that_knows_the_true_variables(model):
    rows, wrong, z = queries(20_000, 1)
    _, _, z_train = queries(4000, 0)
    known = LogisticRegression().fit(z_train, queries(4000, 0)[1]).decision_function(z)
    best = roc_auc_score(wrong, known)
    assert roc_auc_score(wrong, -model.belief(rows)) > best - 0.005


def test_more_of_anything_is_never_better(model):
    rows, _, _ = queries(300, 2)
    before = model.belief(rows)
    for feature in range(4):
        for scale in (1e-4, 1.0, 1e4):
            worse = rows.copy()
            worse[:, feature] += scale * np.abs(rows[:, feature])
            assert (model.belief(worse) <= before + 1e-9).all()


def test_order_is_kept_beyond_what_the_calibration_saw(model):
    rows = np.tile(queries(50, 3)[0].mean(0), (3, 1))
    rows[:, 0] = [1e3, 2e3, 4e3]
    belief = model.belief(rows)
    assert belief[0] > belief[1] > belief[2]


def test_a_feature_that_speaks_the_other_way_is_left_out():
    rng = np.random.default_rng(4)
    wrong = rng.random(2000) < 0.4
    rows = rng.normal(size=(2000, 4))
    rows[:, 0] += 2.0 * wrong
    rows[:, 3] -= 2.0 * wrong
    model = MatchModel.fit(rows, wrong)
    assert model.weights[0].sum() > 0.5
    assert np.all(model.weights[3] < 1e-3)


def test_features_by_name_and_by_row_agree(model):
    features = MatchFeatures(distance=0.3, uncertainty=1e-3, ambiguity=40.0, ratio=0.9)
    row = [0.3, 1e-3, 40.0, 0.9]
    assert model.false_match_probability(features) == model.false_match_probability([row])[0]
    assert tuple(vars(features)) == FEATURES


def test_what_is_not_finite_is_not_believed(model):
    rows = np.array([[0.3, np.nan, 40.0, 0.9], [0.3, 1e-3, np.inf, 0.9]])
    assert np.all(model.false_match_probability(rows) == 1.0)


def test_a_constant_feature_does_no_harm():
    rows, wrong, _ = queries(500, 5)
    rows[:, 2] = 0.0
    model = MatchModel.fit(rows, wrong)
    other = rows.copy()
    other[:, 2] = 7.0
    assert np.isfinite(model.belief(other)).all()
    assert np.array_equal(model.belief(other), model.belief(rows))


def test_a_model_survives_its_file(model, tmp_path):
    model.save(tmp_path / 'model.json')
    loaded = MatchModel.load(tmp_path / 'model.json')
    rows, _, _ = queries(100, 6)
    assert np.array_equal(loaded.belief(rows), model.belief(rows))


def test_wrong_files_are_refused(model, tmp_path):
    path = tmp_path / 'model.json'
    path.write_text('no json')
    with pytest.raises(MapError, match='no model'):
        MatchModel.load(path)
    path.write_text(json.dumps({**model.plain(), 'weights': [[1.0, 2.0]]}))
    with pytest.raises(MapError, match='fit together'):
        MatchModel.load(path)


def test_a_fit_without_both_outcomes_is_refused():
    rows, _, _ = queries(50, 7)
    with pytest.raises(DataError, match='all 50 matches are right'):
        MatchModel.fit(rows, np.zeros(50, bool))
    with pytest.raises(DataError, match='4 features'):
        MatchModel.fit(rows[:, :2], np.arange(50) % 2)
