"""Two vehicles share one map: each answers with the other's places, and never mistakes a number."""

import threading

import numpy as np
import pytest
from made_up_places import Ensemble, Submaps, calibration, cloud_of, pose_of

from lcd_common import se3
from lcd_common.errors import DataError, MapError
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.place_recognizer import PlaceRecognizer, PlaceRecognizerConfig
from uncertain_place_recognition.retrieval.engines import IndexConfig, IndexMaker
from uncertain_place_recognition.retrieval.fleet_place import (
    elsewhere_id,
    is_elsewhere,
    place_key,
    tile_of,
    tiles_around,
)
from uncertain_place_recognition.retrieval.qdrant_index import QdrantConfig, open_client
from uncertain_place_recognition.trust import Trust


@pytest.fixture
def client():
    pytest.importorskip('qdrant_client', reason='qdrant-client is not installed')
    return open_client(QdrantConfig())


def vehicle(name, client, ensemble='ab', judge=None, delay=0, **qdrant):
    """Make a recognizer of one of the vehicles; `client` stands for the server."""
    settings = QdrantConfig(vehicle=name, tile=100.0, **qdrant)
    index = IndexMaker(IndexConfig('qdrant'), qdrant=settings, client=client)
    answers = PlaceRecognizerConfig(delay=delay, matches=3)
    return PlaceRecognizer(Ensemble(), Submaps(), judge, answers, None, index, fingerprint=ensemble)


def seen(one, *numbers, covariance=None):
    for id, number in enumerate(numbers):
        one.add(cloud_of(number), pose_of(number), stamp_ns=id, covariance=covariance)


def test_each_answers_with_the_places_of_both(client):
    red, blue = vehicle('red', client), vehicle('blue', client)
    seen(red, 0, 1, 2, covariance=np.diag([4.0, 1, 1, 1, 1, 1]))
    seen(blue, 10, 11)
    own = blue.locate(cloud_of(11)).best
    assert own.place_id == 1
    np.testing.assert_array_equal(own.T_map_base, pose_of(11))
    other = blue.locate(cloud_of(1)).best  # its number is 1 on red, which blue has, too
    np.testing.assert_array_equal(other.T_map_base, pose_of(1))
    assert is_elsewhere(other.place_id)
    assert other.covariance[0, 0] == pytest.approx(25.0 + 4.0)
    told = blue.elsewhere(other.place_id)
    assert (told.vehicle, told.number, told.place.stamp_ns) == ('red', 1, 1)
    assert blue.place(other.place_id).id == other.place_id
    assert blue.cloud(other.place_id) is None, 'clouds are not shared'
    answer = blue.locate(cloud_of(2))
    assert answer.database_size == 5
    np.testing.assert_array_equal(blue.locate(cloud_of(2)).best.T_map_base, pose_of(2))
    assert (len(blue), blue.next_id, [p.id for p in blue.places()]) == (2, 2, [0, 1])
    with pytest.raises(DataError, match='is not in the map'):
        red.elsewhere(other.place_id)


def test_the_name_of_a_place_is_the_same_for_all_others(client):
    red, blue, green = (vehicle(name, client) for name in ('red', 'blue', 'green'))
    seen(red, 4)
    ids = {one.locate(cloud_of(4)).best.place_id for one in (blue, green)}
    assert ids == {elsewhere_id(place_key('ab', 'red', 0, 0))}
    assert red.locate(cloud_of(4)).best.place_id == 0


def test_another_ensemble_s_places_are_not_seen(client):
    red, blue = vehicle('red', client, 'ab'), vehicle('blue', client, 'cd')
    seen(red, 0, 1)
    answer = blue.locate(cloud_of(1))
    assert answer.matches == () and answer.database_size == 0


def test_corrections_reach_the_other_vehicle(client):
    red, blue = vehicle('red', client), vehicle('blue', client, radius=10.0)
    seen(red, *range(300))
    assert blue.locate(cloud_of(7), near=pose_of(7)[:3, 3]).best is not None
    red.move({number: pose_of(number + 100) for number in range(300)} | {999: pose_of(0)})
    moved = blue.locate(cloud_of(7), near=pose_of(107)[:3, 3])
    np.testing.assert_array_equal(moved.best.T_map_base, pose_of(107))
    np.testing.assert_array_equal(blue.place(moved.best.place_id).T_map_base, pose_of(107))
    before = blue.locate(cloud_of(7), near=pose_of(7)[:3, 3])
    assert before.matches == (), 'the place has left that tile'


def test_a_prior_narrows_the_search_and_so_the_map_that_is_judged(client):
    judge = Trust(calibration(database_size=10))
    red = vehicle('red', client)
    blue = vehicle('blue', client, radius=40.0, judge=judge)
    seen(red, *range(40))
    anywhere = blue.locate(cloud_of(20))
    assert anywhere.database_size == 40 and 'has 40 places' in anywhere.withdrawn
    near = blue.locate(cloud_of(20), near=pose_of(20)[:3, 3])
    assert near.database_size == 7  # tiles from 500 to 700 m, a place every 30 m
    assert near.withdrawn is None and near.best.accepted
    np.testing.assert_array_equal(near.best.T_map_base, pose_of(20))


def test_new_places_wait_before_others_see_them(client):
    red, blue = vehicle('red', client, delay=3), vehicle('blue', client)
    seen(red, *range(3))
    assert blue.locate(cloud_of(0)).matches == ()
    red.move({0: pose_of(50)})
    red.add(cloud_of(3), pose_of(3), stamp_ns=3)
    np.testing.assert_array_equal(blue.locate(cloud_of(0)).best.T_map_base, pose_of(50))


def test_the_next_drive_finds_the_last_one_s_places(client):
    red = vehicle('red', client)
    seen(red, 0, 1)
    red.clear()
    red.add(cloud_of(9), pose_of(9), stamp_ns=1000)  # number 0 again
    best = red.locate(cloud_of(0)).best
    np.testing.assert_array_equal(best.T_map_base, pose_of(0))
    assert is_elsewhere(best.place_id) and red.elsewhere(best.place_id).vehicle == 'red'
    assert red.locate(cloud_of(9)).best.place_id == 0
    assert red.searchable == 3


def test_a_vehicle_saves_its_own_places_and_loading_them_adds_none_twice(client, tmp_path):
    red, blue = vehicle('red', client), vehicle('blue', client)
    seen(red, 0, 1, 2)
    seen(blue, 10)
    red.save(tmp_path / 'red')
    assert red.load(tmp_path / 'red') == 3
    assert red.searchable == 4
    assert [red.locate(cloud_of(n)).best.place_id for n in range(3)] == [0, 1, 2]
    alone = vehicle('red', open_client(QdrantConfig()))
    assert alone.load(tmp_path / 'red') == 3 == alone.searchable


def test_a_server_that_is_away_costs_the_answer_but_no_place(client, monkeypatch):
    red, blue = vehicle('red', client), vehicle('blue', client)
    seen(red, 0)

    def away(*arguments, **options):
        raise OSError('no route to host')

    with monkeypatch.context() as broken:
        broken.setattr(client, 'upsert', away)
        with pytest.raises(MapError, match='no route to host'):
            red.add(cloud_of(1), pose_of(1), stamp_ns=1)
    assert len(red) == 2
    assert red.locate(cloud_of(1)).best.place_id == 1
    np.testing.assert_array_equal(blue.locate(cloud_of(1)).best.T_map_base, pose_of(1))


def test_a_folder_serves_several_threads(tmp_path):
    pytest.importorskip('qdrant_client', reason='qdrant-client is not installed')
    one = vehicle('red', None, folder=str(tmp_path / 'map'))
    worker = threading.Thread(target=seen, args=(one, 0, 1))
    worker.start()
    worker.join()
    assert one.locate(cloud_of(1)).best.place_id == 1
    one.close()


def test_tiles():
    at = se3.from_rotation_translation(np.eye(3), [-0.5, 250.0, 9.0])
    assert tile_of(at, 100.0) == '-1:2'
    assert tile_of(at, 100.0) in tiles_around(0.0, 200.0, 50.0, 100.0)
    assert tiles_around(50.0, 50.0, 10.0, 100.0) == ['0:0']
    assert len(tiles_around(0.0, 0.0, 100.0, 100.0)) == 9


def test_ids_fit_into_63_bits_and_differ():
    ids = {
        elsewhere_id(place_key(ensemble, name, number, stamp))
        for ensemble in ('ab', 'cd')
        for name in ('red', 'blue')
        for number in range(20)
        for stamp in (0, 1)
    }
    assert len(ids) == 160
    assert all(2**62 <= id < 2**63 and is_elsewhere(id) for id in ids)
    assert not is_elsewhere(Place(7, 0, np.eye(4)).id)
