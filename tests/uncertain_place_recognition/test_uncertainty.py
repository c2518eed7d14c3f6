import numpy as np
import pytest

from lcd_common.errors import DataError
from uncertain_place_recognition.uncertainty import (
    feature_variance,
    mean_descriptor,
    total_uncertainty,
    unit_uncertainty,
)


@pytest.fixture
def members():
    return np.random.default_rng(0).normal(1.0, 0.3, (5, 8))


def test_equation_19_by_hand(members):
    mean = sum(members) / 5
    assert mean_descriptor(members) == pytest.approx(mean, abs=1e-6)
    expected = sum((v - mean) ** 2 for v in members) / 5
    assert feature_variance(members) == pytest.approx(expected)


def test_equation_23_is_the_mean_squared_distance_from_the_mean(members):
    mean = members.mean(0)
    expected = np.mean([np.linalg.norm(v - mean) ** 2 for v in members])
    assert total_uncertainty(members, normalised=False) == pytest.approx(expected)
    assert total_uncertainty(members) == pytest.approx(expected / (mean @ mean))


def test_normalised_uncertainty_forgets_the_scale_and_the_plain_sum_does_not(members):
    assert total_uncertainty(7.0 * members) == pytest.approx(total_uncertainty(members))
    plain = total_uncertainty(members, normalised=False)
    assert total_uncertainty(7.0 * members, normalised=False) == pytest.approx(49.0 * plain)


def test_unit_uncertainty_forgets_the_scale_of_each_member(members):
    scaled = members * np.array([1.0, 2.0, 3.0, 4.0, 5.0])[:, None]
    assert unit_uncertainty(scaled) == pytest.approx(unit_uncertainty(members))
    units = members / np.linalg.norm(members, axis=1, keepdims=True)
    assert unit_uncertainty(members) == pytest.approx(1.0 - np.sum(units.mean(0) ** 2))


def test_one_member_or_equal_members_are_certain(members):
    assert total_uncertainty(members[:1]) == 0.0
    assert total_uncertainty(np.tile(members[:1], (5, 1))) == pytest.approx(0.0, abs=1e-12)


def test_opposite_members_are_infinitely_uncertain():
    assert total_uncertainty([[1.0, 0.0], [-1.0, 0.0]]) == np.inf
    assert unit_uncertainty([[1.0, 0.0], [-1.0, 0.0]]) == 1.0


def test_many_inputs_at_once(members):
    many = np.stack([members, 2.0 * members[::-1]])
    expected = [total_uncertainty(one, normalised=False) for one in many]
    assert total_uncertainty(many, normalised=False) == pytest.approx(expected)
    assert mean_descriptor(many).shape == (2, 8)


def test_a_single_vector_is_no_ensemble():
    with pytest.raises(DataError, match='M x D'):
        total_uncertainty(np.ones(8))
