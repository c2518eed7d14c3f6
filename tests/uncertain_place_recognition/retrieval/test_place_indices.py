"""What every index must do, whichever engine answers; the oracle compares all by hand."""

import numpy as np
import pytest

from lcd_common.errors import ConfigError, DataError, MapError
from uncertain_place_recognition.retrieval.exact_index import CompactIndex, ExactIndex
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig

D = 16


def exact(metric, window=None):
    return ExactIndex(D, metric, window)


def compact(metric, window=None):
    if metric != 'cosine':
        pytest.skip('the compact search compares by cosine alone')
    return CompactIndex(D, window)


def hnsw(metric, window=None):
    return faiss_index('hnsw', metric, window)


def ivf(metric, window=None):
    return faiss_index('ivf', metric, window)


def faiss_index(kind, metric, window):
    pytest.importorskip('faiss', reason='faiss-cpu is not installed')
    from uncertain_place_recognition.retrieval.faiss_index import FaissConfig, FaissIndex

    # So broad that nothing is missed: here the interface is tested, not what faiss leaves out.
    settings = FaissConfig(kind=kind, exact_below=100, search_breadth=600, probes=600)
    return FaissIndex(D, metric, window, settings)


def qdrant(metric, window=None):
    pytest.importorskip('qdrant_client', reason='qdrant-client is not installed')
    from uncertain_place_recognition.retrieval.qdrant_index import QdrantIndex

    return QdrantIndex(D, metric, window)


@pytest.fixture(params=[exact, compact, hnsw, ivf, qdrant], ids=lambda make: make.__name__)
def make(request):
    return request.param


@pytest.fixture(params=['cosine', 'euclidean'])
def metric(request):
    return request.param


@pytest.fixture(scope='module')
def rows():
    rng = np.random.default_rng(1)
    return (rng.normal(size=(500, D)) * rng.uniform(0.5, 2.0, (500, 1))).astype(np.float32)


@pytest.fixture(scope='module')
def queries(rows):
    return rows[::50] + np.random.default_rng(2).normal(0, 0.3, (10, D)).astype(np.float32)


def by_hand(rows, query, metric):
    cosine = np.array([r @ query / np.linalg.norm(r) / np.linalg.norm(query) for r in rows])
    apart = np.array([np.sqrt(((r - query) ** 2).sum()) for r in rows])
    return np.argsort(-cosine if metric == 'cosine' else apart, kind='stable'), cosine, apart


def test_the_order_is_that_of_comparing_all(make, metric, rows, queries):
    index = make(metric)
    index.add_many(np.arange(500) + 1000, rows)
    for query in queries:
        order, cosine, apart = by_hand(rows, query, metric)
        found = index.search(query, 7)
        assert found.place_id.tolist() == (order[:7] + 1000).tolist()
        assert found.similarity == pytest.approx(cosine[order[:7]], abs=1e-5)
        assert found.distance == pytest.approx(apart[order[:7]], abs=1e-4)


def test_a_growing_index_answers_as_one_filled_at_once(make, metric, rows, queries):
    grown, filled = make(metric), make(metric)
    for number, row in enumerate(rows[:250]):
        grown.add(number, row)
    filled.add_many(np.arange(250), rows[:250])
    for query in queries:
        assert grown.search(query, 5).place_id.tolist() == filled.search(query, 5).place_id.tolist()


def test_recent_entries_are_not_answered(make, rows):
    index = make('cosine', InsertionConfig(seconds=10.0))
    second = 1_000_000_000
    for number in range(30):
        index.add(number, rows[number], number * second)
        found = index.search(rows[number], 30, number * second).place_id
        assert sorted(found) == list(range(max(0, number - 9)))
    assert (len(index), index.searchable) == (30, 20)
    # Without a time, what waits still waits; later, it is there.
    assert 25 not in index.search(rows[25], 30).place_id
    assert index.search(rows[25], 1, 35 * second).place_id.tolist() == [25]


def test_a_saved_index_is_found_again_with_what_waited(make, metric, rows, queries, tmp_path):
    index = make(metric, InsertionConfig(entries=3))
    for number in range(40):
        index.add(number, rows[number], number)
    assert index.searchable == 37
    index.save(tmp_path / 'map' / 'index.npz')
    loaded = make(metric)
    loaded.load(tmp_path / 'map' / 'index.npz')
    assert len(loaded) == loaded.searchable == 40
    for query in queries:
        order, _, _ = by_hand(rows[:40], query, metric)
        assert loaded.search(query, 5).place_id.tolist() == order[:5].tolist()


def test_an_index_of_one_engine_opens_in_another(make, rows, tmp_path):
    index = make('cosine')
    index.add_many(np.arange(40), rows[:40])
    index.save(tmp_path / 'index.npz')
    other = ExactIndex(D)
    other.load(tmp_path / 'index.npz')
    assert other.search(rows[11], 1).place_id.tolist() == [11]


def test_few_entries_and_none(make, rows):
    index = make('cosine')
    assert len(index.search(rows[0], 5)) == 0
    index.add(7, rows[0])
    assert index.search(rows[3], 5).place_id.tolist() == [7]
    assert len(index.search(rows[3], 0)) == 0


def test_equal_descriptors_and_one_of_zeros(make, rows):
    index = make('cosine')
    for number in range(4):
        index.add(number, rows[0])
    index.add(9, np.zeros(D))
    found = index.search(rows[0], 5)
    assert sorted(found.place_id[:4]) == [0, 1, 2, 3]
    assert found.similarity[:4] == pytest.approx(1.0, abs=1e-5)
    assert found.place_id[4] == 9 and found.similarity[4] == pytest.approx(0.0, abs=1e-6)


def test_wrong_descriptors_are_refused(make):
    index = make('cosine')
    with pytest.raises(DataError, match='16 numbers, got 3'):
        index.add(0, np.ones(3))
    with pytest.raises(DataError, match='16 numbers, got 3'):
        index.search(np.ones(3), 1)
    with pytest.raises(DataError, match='finite'):
        index.add(0, np.full(D, np.nan))
    with pytest.raises(DataError, match='another ensemble'):
        index.add_many(np.arange(2), np.ones((3, D)))
    assert len(index) == 0


def test_wrong_files_are_refused(make, rows, tmp_path):
    index = make('cosine')
    other = ExactIndex(D, 'euclidean')
    other.add(0, rows[0])
    other.save(tmp_path / 'other.npz')
    with pytest.raises(MapError, match='euclidean'):
        index.load(tmp_path / 'other.npz')
    longer = ExactIndex(D + 1)
    longer.add(0, np.ones(D + 1))
    longer.save(tmp_path / 'longer.npz')
    with pytest.raises(MapError, match='another ensemble'):
        index.load(tmp_path / 'longer.npz')
    (tmp_path / 'text.npz').write_text('no index')
    with pytest.raises(MapError, match='holds no index'):
        index.load(tmp_path / 'text.npz')


def test_an_unknown_metric_is_named():
    with pytest.raises(ConfigError, match='cosine, euclidean'):
        ExactIndex(D, 'manhattan')
