import numpy as np
import pytest

from lcd_common.errors import DataError
from lcd_loop_closure.descriptor_index import DescriptorIndex, Euclidean, Match


def filled(vectors, delay_m=30.0, step_m=2.0):
    index = DescriptorIndex(Euclidean(vectors.shape[1]), delay_m)
    for i, vector in enumerate(vectors):
        index.add(i, vector, step_m * i)
    return index


def test_nearest_is_exact_while_the_index_grows():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(300, 16)).astype(np.float32)
    index = filled(vectors, delay_m=0.0, step_m=0.0)
    for query in rng.normal(size=(20, 16)).astype(np.float32):
        distances = np.linalg.norm(vectors - query, axis=1)
        expected = np.argsort(distances)[:7]
        found = index.nearest(query, 0.0, 7)
        assert [match.id for match in found] == expected.tolist()
        np.testing.assert_allclose([match.distance for match in found], distances[expected], 1e-5)
        assert all(match.yaw is None for match in found)


@pytest.mark.parametrize(('travelled_m', 'expected'), [(29.9, -1), (30.0, 0), (61.0, 15)])
def test_the_recent_past_is_left_out(travelled_m, expected):
    vectors = np.arange(40, dtype=np.float32)[:, None]
    found = filled(vectors).nearest(np.array([39.0], np.float32), travelled_m, 1)
    assert [match.id for match in found] == ([] if expected < 0 else [expected])


def test_what_came_in_stays_in():
    index = filled(np.arange(40, dtype=np.float32)[:, None])
    index.nearest(np.zeros(1, np.float32), 50.0, 1)
    assert len(index.nearest(np.zeros(1, np.float32), 0.0, 99)) == 11


def test_entries_of_a_loaded_map_come_in_at_once():
    index = DescriptorIndex(Euclidean(1), 30.0)
    index.add(5, np.array([2.0], np.float32), -np.inf)
    assert index.nearest(np.array([3.0], np.float32), 0.0, 1) == [Match(5, 1.0, None)]


def test_removed_and_cleared_entries_are_gone():
    index = filled(np.arange(40, dtype=np.float32)[:, None])
    index.nearest(np.zeros(1, np.float32), 50.0, 1)
    index.remove(0)
    index.remove(39)
    index.remove(1000)
    assert len(index) == 38
    ids = [match.id for match in index.nearest(np.zeros(1, np.float32), 1e9, 99)]
    assert ids == list(range(1, 39))
    index.clear()
    assert len(index) == 0 and index.nearest(np.zeros(1, np.float32), 1e9, 1) == []


def test_equal_distances_come_in_order_of_sight():
    index = filled(np.zeros((5, 3), np.float32), delay_m=0.0)
    assert [match.id for match in index.nearest(np.zeros(3, np.float32), 99.0, 5)] == [
        0,
        1,
        2,
        3,
        4,
    ]


def test_a_descriptor_of_another_length_is_refused():
    with pytest.raises(DataError, match='expected a descriptor of 256 numbers, got 3'):
        DescriptorIndex(Euclidean(256), 0.0).add(0, np.zeros(3, np.float32), 0.0)


def test_unit_vectors_are_searched_compactly_with_the_same_answers():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(500, 64)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    compact = DescriptorIndex(Euclidean(64, unit_length=True), 10.0)
    plain = DescriptorIndex(Euclidean(64), 10.0)
    for i, vector in enumerate(vectors):
        for index in (compact, plain):
            index.add(i, vector, float(i))
    for removed in (3, 77, 495):
        compact.remove(removed)
        plain.remove(removed)
    for query in vectors[::50]:
        found, expected = (index.nearest(query, 500.0, 5) for index in (compact, plain))
        assert [match.id for match in found] == [match.id for match in expected]
        np.testing.assert_allclose(
            [match.distance for match in found], [match.distance for match in expected], atol=1e-5
        )
    assert len(compact) == len(plain) == 497
