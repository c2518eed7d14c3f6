import numpy as np
import pytest

from lcd_common.errors import DataError
from uncertain_place_recognition.ambiguity import (
    AmbiguityConfig,
    match_spread,
    second_place_ratio,
)


def test_matches_of_one_place_are_not_ambiguous():
    positions = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert match_spread([1.0, 1.0, 1.0], positions) < 1.0
    assert second_place_ratio([1.0, 1.0, 1.0], positions) == 0.0


def test_two_equal_places_spread_by_half_their_distance():
    # Variance of +-50 m on one axis is 2500; the mean with the other axis' 0 is 1250.
    positions = [[0.0, 0.0], [100.0, 0.0]]
    assert match_spread([0.4, 0.4], positions) == pytest.approx(np.sqrt(1250.0))
    assert second_place_ratio([0.4, 0.4], positions) == 1.0


def test_a_worse_match_counts_less_by_its_relative_distance():
    positions = [[0.0, 0.0], [100.0, 0.0]]
    settings = AmbiguityConfig(sharpness=10.0)
    weight = np.exp(-10.0 * 0.1) / (1.0 + np.exp(-10.0 * 0.1))
    expected = np.sqrt(weight * (1.0 - weight) * 100.0**2 / 2.0)
    for scale in (1.0, 1000.0):
        found = match_spread([0.5 * scale, 0.55 * scale], positions, settings)
        assert found == pytest.approx(expected)
    assert second_place_ratio([0.5, 0.55], positions) == pytest.approx(0.5 / 0.55)


@pytest.mark.parametrize('side', [[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]])
def test_deviations_are_cut_off_on_every_side(side):
    far = 4000.0 * np.array(side)
    spread = match_spread([1.0, 1.0], np.array([[0.0, 0.0], far]), AmbiguityConfig(cap=500.0))
    assert spread == pytest.approx(500.0 / np.sqrt(2.0))


def test_an_identical_descriptor_outweighs_all_others():
    positions = [[0.0, 0.0], [90.0, 0.0], [0.0, 90.0]]
    assert match_spread([0.0, 0.1, 0.2], positions) == 0.0
    assert second_place_ratio([0.0, 0.1, 0.2], positions) == 0.0
    assert match_spread([0.0, 0.0, 0.2], positions) > 30.0
    assert second_place_ratio([0.0, 0.0, 0.2], positions) == 1.0


def test_many_queries_at_once_and_only_the_best_matches():
    rng = np.random.default_rng(0)
    distance = np.sort(rng.uniform(0.2, 0.3, (6, 12)), axis=1)
    positions = rng.uniform(-200, 200, (6, 12, 2))
    settings = AmbiguityConfig(matches=5)
    for function in (match_spread, second_place_ratio):
        expected = [function(d[:5], p[:5]) for d, p in zip(distance, positions, strict=True)]
        assert function(distance, positions, settings) == pytest.approx(np.array(expected))


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(DataError, match='K x 2'):
        match_spread([1.0, 2.0], [[0.0, 0.0]])
