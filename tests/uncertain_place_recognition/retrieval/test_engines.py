"""Every engine can be chosen, answers through the recognizer, and keeps maps that others open."""

import sys

import numpy as np
import pytest
from made_up_places import Ensemble, Submaps, calibration, cloud_of, pose_of

from lcd_common.errors import ConfigError, MapError
from uncertain_place_recognition.missing_package import MissingPackageError
from uncertain_place_recognition.place_recognizer import PlaceRecognizer, PlaceRecognizerConfig
from uncertain_place_recognition.retrieval.engines import IndexConfig, IndexMaker
from uncertain_place_recognition.retrieval.exact_index import CompactIndex, ExactIndex
from uncertain_place_recognition.retrieval.faiss_index import FaissConfig, FaissIndex
from uncertain_place_recognition.retrieval.insertion_window import InsertionConfig
from uncertain_place_recognition.retrieval.qdrant_index import QdrantConfig, QdrantIndex
from uncertain_place_recognition.trust import Trust

ENGINES = {'exact': ExactIndex, 'compact': CompactIndex, 'faiss': FaissIndex, 'qdrant': QdrantIndex}
PACKAGES = {'faiss': 'faiss', 'qdrant': 'qdrant_client'}


def maker(engine, **options):
    if engine in PACKAGES:
        pytest.importorskip(PACKAGES[engine])
    return IndexMaker(IndexConfig(engine), FaissConfig(exact_below=10), **options)


def recognizer(engine, delay=0, judge=None, **options):
    settings = PlaceRecognizerConfig(delay=delay, matches=3)
    index = maker(engine, **options)
    return PlaceRecognizer(Ensemble(), Submaps(), judge, settings, None, index, fingerprint='ab')


@pytest.fixture(params=ENGINES)
def engine(request):
    return request.param


def test_the_chosen_engine_is_made(engine):
    assert type(recognizer(engine)._index) is ENGINES[engine]


def test_a_map_is_saved_loaded_and_opened_by_all_others(engine, tmp_path):
    made = recognizer(engine, delay=4, judge=Trust(calibration()))
    for number in range(20):
        made.add(cloud_of(number), pose_of(number), stamp_ns=number, covariance=np.eye(6))
    assert (len(made), made.searchable) == (20, 16)
    made.move({3: pose_of(33)})
    made.save(tmp_path / 'map')
    for other in (engine, 'exact'):
        loaded = recognizer(other, delay=4)
        assert loaded.load(tmp_path / 'map') == 20 == loaded.searchable
        for number in (3, 12, 19):
            best = loaded.locate(cloud_of(number)).best
            assert best.place_id == number
            assert best.similarity == pytest.approx(1.0, abs=1e-3)
        np.testing.assert_array_equal(loaded.place(3).T_map_base, pose_of(33))
        loaded.add(cloud_of(40), pose_of(40), stamp_ns=40)
        loaded.save(tmp_path / 'again')
        assert recognizer('exact').load(tmp_path / 'again') == 21
        loaded.clear()
        assert loaded.locate(cloud_of(3)).matches == ()


def test_a_map_whose_parts_do_not_belong_together_is_refused(tmp_path):
    for name, first in (('a', 0), ('b', 100)):
        made = recognizer('exact')
        for number in range(first, first + 2):
            made.add(cloud_of(number), pose_of(number), stamp_ns=number, id=number)
        made.save(tmp_path / name)
    (tmp_path / 'b' / 'descriptors.npz').replace(tmp_path / 'a' / 'descriptors.npz')
    with pytest.raises(MapError, match='descriptors are of other places'):
        recognizer('exact').load(tmp_path / 'a')


def test_what_an_engine_cannot_do_is_said():
    window = InsertionConfig()
    with pytest.raises(ConfigError, match='the calibration ranks by euclidean: choose the engine'):
        maker('compact').make(4, 'euclidean', window, '')
    with pytest.raises(ConfigError, match='engine must be one of exact, compact, faiss, qdrant'):
        IndexConfig('annoy')


@pytest.mark.parametrize(('engine', 'package'), PACKAGES.items())
def test_a_missing_package_is_named(engine, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=f'pip install {package.split("_")[0]}'):
        IndexMaker(IndexConfig(engine)).make(4, 'cosine', InsertionConfig(), '')


def test_a_folder_outlives_a_reset_and_is_let_go(tmp_path):
    options = {'qdrant': QdrantConfig(folder=str(tmp_path / 'shared'), vehicle='red')}
    made = recognizer('qdrant', **options)
    for number in range(3):
        made.add(cloud_of(number), pose_of(number), stamp_ns=number)
    made.clear()
    best = made.locate(cloud_of(1)).best
    assert (len(made), made.elsewhere(best.place_id).number) == (0, 1)
    made.close()
    recognizer('qdrant', **options).close()
