"""Rules of the methods, each against its formula written out."""

import numpy as np
import pytest

from uncertain_place_recognition.evaluation.ranking import (
    rank_aleatoric,
    rank_mean,
    rank_per_member,
    rank_single,
)


@pytest.fixture
def arrays():
    rng = np.random.default_rng(0)
    database = rng.normal(size=(40, 4, 6)) * rng.uniform(0.5, 3.0, (40, 1, 1))
    return database.astype(np.float32), rng.normal(size=(9, 4, 6)).astype(np.float32)


def cosine(a, b):
    return a @ b / np.linalg.norm(a) / np.linalg.norm(b)


def apart(a, b):
    return np.linalg.norm(a - b)


def order_of(values):
    return np.argsort(values, kind='stable')


@pytest.mark.parametrize('metric', ['cosine', 'euclidean'])
def test_one_network_and_the_mean_of_members(arrays, metric):
    database, queries = arrays
    single = rank_single(database, queries, metric, 7)
    mean = rank_mean(database, queries, metric, 7)
    for q in range(9):
        for ranking, of in ((single, lambda x: x[0]), (mean, lambda x: x.mean(0))):
            similar = np.array([cosine(of(queries[q]), of(row)) for row in database])
            far = np.array([apart(of(queries[q]), of(row)) for row in database])
            best = order_of(-similar if metric == 'cosine' else far)[:7]
            assert ranking.entry[q].tolist() == best.tolist()
            assert ranking.similarity[q] == pytest.approx(similar[best], abs=1e-5)
            assert ranking.distance[q] == pytest.approx(far[best], abs=1e-5)
            assert ranking.doubt['distance'][q] == pytest.approx(far[best[0]], abs=1e-5)
            assert ranking.doubt['similarity'][q] == pytest.approx(1 - similar[best[0]], abs=1e-5)
        members = queries[q].astype(float)
        u = ((members - members.mean(0)) ** 2).mean(0).sum()
        assert mean.doubt['u'][q] == pytest.approx(u)
        assert mean.doubt['u_norm'][q] == pytest.approx(u / (members.mean(0) ** 2).sum())


@pytest.mark.parametrize('metric', ['cosine', 'euclidean'])
def test_a_database_for_each_member(arrays, metric):
    database, queries = arrays
    ranking = rank_per_member(database, queries, metric, 7)
    for q in range(9):
        similar = np.array([[cosine(queries[q, m], row[m]) for m in range(4)] for row in database])
        far = np.array([[apart(queries[q, m], row[m]) for m in range(4)] for row in database])
        best = order_of(-similar.mean(1) if metric == 'cosine' else far.mean(1))[:7]
        assert ranking.entry[q].tolist() == best.tolist()
        assert ranking.similarity[q] == pytest.approx(similar.mean(1)[best], abs=1e-5)
        assert ranking.distance[q] == pytest.approx(far.mean(1)[best], abs=1e-5)
        assert ranking.doubt['variance'][q] == pytest.approx(similar[best[0]].var(), abs=1e-5)
        assert ranking.doubt['similarity'][q] == pytest.approx(
            1 - similar[best[0]].mean(), abs=1e-5
        )


def test_the_thesis_example_of_similarity_against_its_variance():
    # Mean similarity of 0.5 either way: all members at 0.5, or half of them at 0 and half at 1.
    axis, half = np.array([1.0, 0.0]), np.array([0.5, np.sqrt(0.75)])
    database = np.tile(axis, (1, 2, 1)).astype(np.float32)
    agreed = np.stack([half, half])[None].astype(np.float32)
    split = np.stack([axis, [0.0, 1.0]])[None].astype(np.float32)
    for queries, variance in ((agreed, 0.0), (split, 0.25)):
        doubt = rank_per_member(database, queries).doubt
        assert doubt['similarity'][0] == pytest.approx(0.5)
        assert doubt['variance'][0] == pytest.approx(variance, abs=1e-7)


def test_a_network_that_predicts_its_variance(arrays):
    database, queries = arrays
    variance = np.random.default_rng(1).uniform(size=(9, 1, 6)).astype(np.float32)
    ranking = rank_aleatoric(variance)(database, queries, 'cosine', 5, None)
    assert ranking.doubt['variance'] == pytest.approx(variance[:, 0].sum(1))
    assert np.array_equal(ranking.entry, rank_single(database, queries, 'cosine', 5).entry)


@pytest.mark.parametrize('rank', [rank_single, rank_mean, rank_per_member])
def test_entries_that_are_taken_away_are_not_answered(arrays, rank):
    database, queries = arrays
    free = rank(database, queries, 'cosine', 40)
    allowed = np.ones((9, 40), bool)
    allowed[np.arange(9), free.entry[:, 0]] = False
    allowed[3] = False
    allowed[3, [5, 6]] = True
    found = rank(database, queries, 'cosine', 4, allowed)
    assert np.array_equal(np.delete(found.entry, 3, 0), np.delete(free.entry[:, 1:5], 3, 0))
    assert set(found.entry[3, :2]) == {5, 6} and np.all(found.entry[3, 2:] == -1)


def test_equal_entries_come_in_their_order():
    same = np.ones((5, 2, 3), np.float32)
    for rank in (rank_single, rank_mean, rank_per_member):
        assert rank(same, same[:1], 'cosine', 5).entry[0].tolist() == [0, 1, 2, 3, 4]
