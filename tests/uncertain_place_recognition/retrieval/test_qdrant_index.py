import sys

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.errors import ConfigError, DataError, MapError
from uncertain_place_recognition.missing_package import MissingPackageError
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.retrieval.fleet_place import is_elsewhere
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.qdrant_index import (
    QdrantConfig,
    QdrantIndex,
    open_client,
)


@pytest.fixture(autouse=True)
def client():
    return pytest.importorskip('qdrant_client', reason='qdrant-client is not installed')


def place(number, x=0.0, y=0.0, stamp_ns=None, covariance=None):
    T_map_base = se3.from_rotation_translation(np.eye(3), [x, y, 0.0])
    return Place(number, number if stamp_ns is None else stamp_ns, T_map_base, covariance)


def add(index, one, descriptor, stamp_ns=None):
    index.note_poses([one])
    index.add(one.id, np.array(descriptor), stamp_ns)


def test_tiles_near_a_position_are_searched_alone_and_together():
    index = QdrantIndex(2, settings=QdrantConfig(tile=100.0, radius=30.0))
    add(index, place(1, x=50.0), [1.0, 0.0])
    add(index, place(2, x=-50.0), [0.9, 0.1])
    add(index, place(3, x=50.0, y=150.0), [0.8, 0.2])
    query = np.array([1.0, 0.0])
    assert index.search(query, 3).place_id.tolist() == [1, 2, 3], 'no position: all of them'
    assert index.search(query, 3).searched == 3
    only = index.search(query, 3, near=np.array([-50.0, 10.0]))
    assert only.place_id.tolist() == [2] and only.searched == 1
    assert index.search(query, 3, near=np.array([10.0, 50.0])).place_id.tolist() == [1, 2]
    assert index.search(query, 3, near=np.array([50.0, 90.0, 7.0])).place_id.tolist() == [1, 3]
    assert len(index.search(query, 3, near=np.array([900.0, 0.0]))) == 0
    with pytest.raises(DataError, match='2 numbers, got 3'):
        index.search(np.ones(3), 1, near=np.zeros(2))


def test_without_a_radius_all_tiles_are_searched():
    index = QdrantIndex(2)
    add(index, place(1, x=5000.0), [1.0, 0.0])
    assert index.search(np.array([1.0, 0.0]), 1, near=np.zeros(3)).place_id.tolist() == [1]


def test_an_entry_lies_in_the_tile_where_it_was_seen_and_moves_with_its_pose():
    settings = QdrantConfig(tile=100.0, radius=1.0)
    index = QdrantIndex(2, window=InsertionConfig(entries=1), settings=settings)
    for number, x in enumerate([50.0, 150.0, 150.0]):
        add(index, place(number, x=x), [1.0, 0.0], number)
    query = np.array([1.0, 0.0])
    assert index.search(query, 3, near=np.array([50.0, 0.0])).place_id.tolist() == [0]
    index.note_poses([place(0, x=250.0), place(2, x=250.0)])  # the last one waits still
    assert len(index.search(query, 3, near=np.array([50.0, 0.0]))) == 0
    add(index, place(3), [1.0, 0.0], 3)
    assert sorted(index.search(query, 3, near=np.array([250.0, 0.0])).place_id) == [0, 2]


def test_vehicles_share_a_collection_and_a_folder_keeps_it(tmp_path):
    folder = str(tmp_path / 'map')
    settings = QdrantConfig(folder=folder, vehicle='red')
    first = QdrantIndex(2, settings=settings)
    add(first, place(5, x=1.0), [2.0, 0.0])
    with pytest.raises(MapError, match='no other process'):
        QdrantIndex(2, settings=settings)
    first.close()
    second = QdrantIndex(2, settings=QdrantConfig(folder=folder, vehicle='blue'))
    add(second, place(5, x=7.0), [0.0, 3.0])
    assert second.searchable == 2, 'equal ids of two vehicles do not overwrite each other'
    found = second.search(np.array([0.0, 1.0]), 2)
    assert found.distance[0] == pytest.approx(2.0), 'lengths of descriptors are kept'
    assert found.place_id[0] == 5 and is_elsewhere(found.place_id[1])
    other = found.elsewhere[int(found.place_id[1])]
    assert (other.vehicle, other.number, other.place.stamp_ns) == ('red', 5, 5)
    assert other.place.T_map_base[0, 3] == 1.0 and other.place.covariance is None
    second.close()


def test_written_twice_is_one_entry_and_another_drive_is_another():
    shared = open_client(QdrantConfig())
    first, again = (QdrantIndex(2, client=shared) for _ in range(2))
    add(first, place(0, x=1.0), [1.0, 0.0])
    add(again, place(0, x=1.0), [1.0, 0.0])
    assert again.searchable == 1
    add(again, place(0, x=9.0, stamp_ns=99), [0.9, 0.1])
    assert again.searchable == 2


def test_entries_of_other_ensembles_are_not_seen():
    shared = open_client(QdrantConfig())
    ours, theirs = (QdrantIndex(2, ensemble=name, client=shared) for name in ('ours', 'theirs'))
    add(theirs, place(1), [1.0, 0.0])
    assert len(ours.search(np.array([1.0, 0.0]), 3)) == 0 == ours.searchable
    assert theirs.searchable == 1


def test_entries_that_nobody_can_place_are_left_out(caplog):
    shared = open_client(QdrantConfig())
    mine, yours = (QdrantIndex(2, client=shared) for _ in range(2))
    yours.add(1, np.array([1.0, 0.0]))
    add(yours, place(2), [0.9, 0.1])
    add(yours, place(3), [0.8, 0.1])
    (broken,) = (key for key, number in yours._own.items() if number == 2)
    shared.set_payload('places', {'T_map_base': [1.0, 2.0]}, points=[broken])
    for _ in range(2):
        found = mine.search(np.array([1.0, 0.0]), 5)
        assert [one.number for one in found.elsewhere.values()] == [3] and len(found) == 1
    assert caplog.text.count('is damaged') == 1
    assert yours.search(np.array([1.0, 0.0]), 5).place_id.tolist() == [1, 2, 3]


def test_what_a_server_missed_is_told_when_it_is_back(monkeypatch):
    index = QdrantIndex(2)
    add(index, place(0, x=1.0), [1.0, 0.0])

    def away(*arguments, **options):
        raise OSError('no route to host')

    with monkeypatch.context() as broken:
        broken.setattr(index._client, 'upsert', away)
        broken.setattr(index._client, 'batch_update_points', away)
        with pytest.raises(MapError, match='no route to host'):
            add(index, place(1, x=2.0), [0.0, 1.0])
        with pytest.raises(MapError, match='no route to host'):
            index.note_poses([place(0, x=5.0)])
        with pytest.raises(MapError, match='no route to host'):
            index.search(np.array([1.0, 0.0]), 2)
    assert index.search(np.array([1.0, 0.0]), 2).place_id.tolist() == [0, 1]
    entries = index._client.scroll('places')[0]
    assert sorted(entry.payload['T_map_base'][3] for entry in entries) == [2.0, 5.0]


def test_places_that_somebody_deleted_are_not_saved_in_silence(tmp_path):
    index = QdrantIndex(2)
    add(index, place(0), [1.0, 0.0])
    index._client.delete('places', list(index._own))
    with pytest.raises(MapError, match='1 of 1 places of this vehicle are gone'):
        index.save(tmp_path / 'index.npz')


def test_tiles_of_another_size_are_refused():
    shared = open_client(QdrantConfig())
    add(QdrantIndex(2, client=shared), place(0), [1.0, 0.0])
    with pytest.raises(MapError, match='has tiles of 250 m, these settings 100 m'):
        QdrantIndex(2, settings=QdrantConfig(tile=100.0), client=shared)


def test_a_shared_map_wants_the_vehicle_s_name(tmp_path):
    with pytest.raises(ConfigError, match='expected the name of this vehicle'):
        QdrantIndex(2, settings=QdrantConfig(folder=str(tmp_path)))


def test_a_collection_of_another_kind_is_refused():
    shared = open_client(QdrantConfig())
    QdrantIndex(2, client=shared)
    with pytest.raises(MapError, match='2 numbers'):
        QdrantIndex(3, client=shared)
    with pytest.raises(MapError, match='ranked by Cosine'):
        QdrantIndex(2, 'euclidean', client=shared)


def test_a_server_that_is_away_is_one_line():
    with pytest.raises(MapError, match=r'127\.0\.0\.1:9 does not answer') as raised:
        QdrantIndex(2, settings=QdrantConfig(url='http://127.0.0.1:9', vehicle='red', timeout=1))
    assert '\n' not in str(raised.value)


def test_a_server_and_a_folder_exclude_each_other(tmp_path):
    with pytest.raises(ConfigError, match='not both'):
        QdrantIndex(2, settings=QdrantConfig(url='http://127.0.0.1:9', folder=str(tmp_path)))


def test_the_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'qdrant_client', None)
    with pytest.raises(MissingPackageError, match='pip install qdrant-client'):
        QdrantIndex(4)
