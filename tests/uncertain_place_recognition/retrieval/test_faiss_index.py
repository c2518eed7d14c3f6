import sys

import numpy as np
import pytest

from uncertain_place_recognition.missing_package import MissingPackageError
from uncertain_place_recognition.retrieval.exact_index import ExactIndex
from uncertain_place_recognition.retrieval.faiss_index import FaissConfig, FaissIndex


@pytest.fixture(scope='module')
def journey():
    """Descriptors that change smoothly along a path, as those of a drive do."""
    pytest.importorskip('faiss', reason='faiss-cpu is not installed')
    steps = np.random.default_rng(0).normal(size=(3000, 32))
    path = np.cumsum(steps, axis=0)
    return (path - path.mean(0)).astype(np.float32)


@pytest.mark.parametrize('kind', ['hnsw', 'ivf'])
def test_nearly_all_neighbours_are_found_with_the_defaults(kind, journey):
    index = FaissIndex(32, settings=FaissConfig(kind=kind, exact_below=500))
    reference = ExactIndex(32)
    for one in (index, reference):
        one.add_many(np.arange(2000), journey[:2000])
        for number in range(2000, 3000):
            one.add(number, journey[number])
    rng = np.random.default_rng(1)
    found = 0
    for number in range(0, 3000, 15):
        query = journey[number] + rng.normal(0, 2.0, 32)
        mine, true = index.search(query, 1), reference.search(query, 1)
        found += mine.place_id[0] == true.place_id[0]
    assert found >= 190, 'of 200'


def test_up_to_the_limit_nothing_is_approximate(journey):
    index = FaissIndex(32, settings=FaissConfig(exact_below=10))
    index.add_many(np.arange(10), journey[:10])
    assert index._graph is None
    index.add(10, journey[10])
    assert index._graph.ntotal == 11 == index.searchable


def test_the_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'faiss', None)
    with pytest.raises(MissingPackageError, match='pip install faiss-cpu'):
        FaissIndex(4)
