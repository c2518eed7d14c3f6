"""Check the file of a calibration, and the features of a match."""

import json

import numpy as np
import pytest
from made_up_places import calibration

from lcd_common.errors import MapError
from uncertain_place_recognition.ambiguity import AmbiguityConfig
from uncertain_place_recognition.retrieval.place_index import Neighbours
from uncertain_place_recognition.trust import Calibration, Trust, match_features


def neighbours(similarity, distance):
    return Neighbours(
        np.arange(len(similarity)),
        np.asarray(similarity, np.float32),
        np.asarray(distance, np.float32),
    )


def test_a_saved_calibration_judges_the_same(tmp_path):
    made = calibration(ambiguity=AmbiguityConfig(matches=3, same_place=0.5), spacing_m=9.5)
    made.save(tmp_path / 'calibration.json')
    loaded = Calibration.load(tmp_path / 'calibration.json', made.ensemble)
    assert loaded.ambiguity == made.ambiguity and loaded.spacing_m == 9.5
    assert Trust(loaded).matches == 3 and Trust(loaded).spacing_m == 9.5
    where = np.array([[0.0, 0, 0], [1, 0, 0], [90, 0, 0]])
    for best in (0.99, 0.8, 0.3):
        found = neighbours([best, 0.3, 0.2], [1 - best, 0.9, 1.0])
        first = Trust(made).judge(found, where, 0.001, 50)
        assert Trust(loaded).judge(found, where, 0.001, 50) == first
        assert first.accepted is (best > 0.7)


def test_other_weights_are_refused(tmp_path):
    calibration().save(tmp_path / 'calibration.json')
    with pytest.raises(MapError, match='calibrates other weights'):
        Calibration.load(tmp_path / 'calibration.json', 'ffff')


@pytest.mark.parametrize('key', ['drift', 'acceptance', 'model', 'metric'])
def test_what_is_missing_is_named(tmp_path, key):
    path = tmp_path / 'calibration.json'
    calibration().save(path)
    plain = json.loads(path.read_text())
    del plain[key]
    path.write_text(json.dumps(plain))
    with pytest.raises(MapError, match=f'{key} is missing'):
        Calibration.load(path)
    for text in ('', '[]', '{"format": "other"}'):
        path.write_text(text)
        with pytest.raises(MapError, match=r'calibration\.json'):
            Calibration.load(path)


def test_features_follow_the_metric():
    found = neighbours([0.9, 0.5], [3.0, 4.0])
    where = np.array([[0.0, 0, 7], [100.0, 0, 9]])
    cosine = match_features(found, where, 0.5, 'cosine', AmbiguityConfig())
    euclidean = match_features(found, where, 0.5, 'euclidean', AmbiguityConfig())
    assert cosine.distance == pytest.approx(0.1) and cosine.ratio == pytest.approx(0.2)
    assert euclidean.distance == pytest.approx(3.0) and euclidean.ratio == pytest.approx(0.75)
    assert cosine.uncertainty == euclidean.uncertainty == 0.5


def test_an_empty_map_is_no_match():
    judgement = Trust(calibration()).judge(neighbours([], []), np.empty((0, 3)), 0.001, 0)
    assert judgement.false_match_probability is None and not judgement.accepted
