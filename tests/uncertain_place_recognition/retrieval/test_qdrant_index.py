import sys

import numpy as np
import pytest

from lcd_common.errors import ConfigError, MapError
from uncertain_place_recognition.missing_package import MissingPackageError
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.qdrant_index import QdrantConfig, QdrantIndex


@pytest.fixture(autouse=True)
def client():
    return pytest.importorskip('qdrant_client', reason='qdrant-client is not installed')


def test_cells_are_searched_alone_and_together():
    index = QdrantIndex(2)
    index.add(1, np.array([1.0, 0.0]), cell='north')
    index.add(2, np.array([0.9, 0.1]), cell='south')
    index.add(3, np.array([0.8, 0.2]), cell='east')
    query = np.array([1.0, 0.0])
    assert index.search(query, 3).place_id.tolist() == [1, 2, 3]
    assert index.search(query, 3, cells=['south']).place_id.tolist() == [2]
    assert index.search(query, 3, cells=['south', 'east']).place_id.tolist() == [2, 3]
    assert len(index.search(query, 3, cells=['west'])) == 0
    assert index.search(query, 3).place_id.tolist() == [1, 2, 3], 'cells are of one search'


def test_an_entry_keeps_the_cell_where_it_was_seen():
    index = QdrantIndex(2, window=InsertionConfig(entries=1))
    index.add(1, np.array([1.0, 0.0]), 1, cell='north')
    index.add(2, np.array([1.0, 0.0]), 2, cell='south')
    index.add(3, np.array([1.0, 0.0]), 3, cell='south')
    assert index.search(np.array([1.0, 0.0]), 3, cells=['north']).place_id.tolist() == [1]


def test_vehicles_share_a_collection_and_a_folder_keeps_it(tmp_path):
    settings = QdrantConfig(folder=str(tmp_path / 'map'))
    first = QdrantIndex(2, settings=settings)
    first.add(5, np.array([2.0, 0.0]))
    with pytest.raises(MapError, match='no other process'):
        QdrantIndex(2, settings=settings)
    first.close()
    second = QdrantIndex(2, settings=settings)
    second.add(5, np.array([0.0, 3.0]))
    assert second.searchable == 2, 'equal ids of two vehicles do not overwrite each other'
    found = second.search(np.array([0.0, 1.0]), 1)
    assert found.distance == pytest.approx([2.0]), 'lengths of descriptors are kept'
    second.close()


def test_a_collection_of_another_kind_is_refused(tmp_path):
    QdrantIndex(2, settings=QdrantConfig(folder=str(tmp_path))).close()
    with pytest.raises(MapError, match='2 numbers'):
        QdrantIndex(3, settings=QdrantConfig(folder=str(tmp_path)))


def test_a_server_that_is_away_is_one_line():
    with pytest.raises(MapError, match=r'127\.0\.0\.1:9 does not answer') as raised:
        QdrantIndex(2, settings=QdrantConfig(url='http://127.0.0.1:9', timeout=1))
    assert '\n' not in str(raised.value)


def test_a_server_and_a_folder_exclude_each_other(tmp_path):
    with pytest.raises(ConfigError, match='not both'):
        QdrantIndex(2, settings=QdrantConfig(url='http://127.0.0.1:9', folder=str(tmp_path)))


def test_the_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'qdrant_client', None)
    with pytest.raises(MissingPackageError, match='pip install qdrant-client'):
        QdrantIndex(4)
