"""Check the answers of the recognizer, its growth and what it keeps."""

import json

import numpy as np
import pytest
from made_up_places import Ensemble, calibration, cloud_of, pose_of, recognizer

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError, MapError
from uncertain_place_recognition.trust import Trust


def filled(count=20, **options):
    made = recognizer(**options)
    for number in range(count):
        made.add(cloud_of(number), pose_of(number), stamp_ns=number)
    return made


def test_a_known_place_is_found_again():
    made = filled(matches=3)
    for number in (0, 7, 19):
        answer = made.locate(cloud_of(number, noise=0.05))
        assert answer.best.place_id == number
        np.testing.assert_array_equal(answer.best.T_map_base, pose_of(number))
        assert len(answer.matches) == 3
        similarity = [match.similarity for match in answer.matches]
        assert similarity == sorted(similarity, reverse=True)
        assert answer.database_size == 20


def test_similarity_and_uncertainty_are_those_of_the_thesis():
    made = filled()
    members = made.embed(cloud_of(3, noise=0.05))
    mean = members.mean(0)
    known = made.embed(cloud_of(3)).mean(0)
    answer = made.locate(members)
    cosine = mean @ known / np.linalg.norm(mean) / np.linalg.norm(known)
    assert answer.best.similarity == pytest.approx(cosine, abs=1e-6)
    assert answer.best.distance == pytest.approx(np.linalg.norm(mean - known), rel=1e-4)
    variance = ((members - mean) ** 2).mean(0)
    np.testing.assert_allclose(answer.variances, variance, rtol=1e-4)
    assert answer.uncertainty == pytest.approx(variance.sum(), rel=1e-4)
    assert answer.uncertainty_normalised == pytest.approx(variance.sum() / (mean @ mean), rel=1e-4)


def test_an_empty_map_answers_nothing():
    answer = recognizer().locate(cloud_of(0))
    assert answer.matches == () and answer.best is None and answer.database_size == 0


def test_without_a_calibration_nothing_is_accepted():
    answer = filled().locate(cloud_of(4))
    assert answer.best.false_match_probability is None
    assert not any(match.accepted for match in answer.matches)
    assert 'nothing is calibrated' in answer.withdrawn


def test_a_calibrated_match_has_a_probability_and_is_accepted_or_not():
    made = filled(judge=Trust(calibration()))
    good = made.locate(cloud_of(4, noise=0.02))
    assert good.withdrawn is None
    assert good.best.accepted and good.best.false_match_probability < 0.2
    bad = made.locate(cloud_of(1000))
    assert not bad.best.accepted and bad.best.false_match_probability > 0.5
    for answer in (good, bad):
        assert not any(match.accepted for match in answer.matches[1:])
        assert all(match.false_match_probability is None for match in answer.matches[1:])


def test_the_guarantee_ends_when_the_map_outgrows_the_calibration():
    made = filled(judge=Trust(calibration(database_size=18)))
    assert made.locate(cloud_of(4)).withdrawn is not None  # 20 of at most 19
    made = filled(judge=Trust(calibration(database_size=19)))
    answer = made.locate(cloud_of(4))
    assert answer.withdrawn is None and answer.best.accepted
    made.add(cloud_of(50), pose_of(50), stamp_ns=99)
    answer = made.locate(cloud_of(4))
    assert 'has 21 places, the calibration had 19' in answer.withdrawn
    assert not answer.best.accepted
    assert answer.best.false_match_probability < 0.2  # still told, but nobody vouches for it


def test_the_drift_alarm_withdraws_the_guarantee_until_a_new_drive():
    made = filled(judge=Trust(calibration()), ensemble=Ensemble())
    for number in range(60):
        assert made.locate(cloud_of(number % 20, noise=0.02)).withdrawn is None
    foreign = made.embed(cloud_of(5))
    foreign = foreign + np.linspace(-0.2, 0.2, 5)[:, None].astype(np.float32)
    for _ in range(200):
        answer = made.locate(foreign)
    assert 'more uncertain than those of the calibration' in answer.withdrawn
    assert not answer.best.accepted
    made.start_drive()
    assert made.locate(cloud_of(5)).withdrawn is None


def test_the_covariance_is_the_resolution_plus_the_place_s_own():
    made = recognizer(position_sigma=4.0, heading_sigma=1.5)
    made.add(cloud_of(0), pose_of(0), stamp_ns=0, covariance=np.diag([9.0, 1, 1, 0.1, 0.1, 0.1]))
    made.add(cloud_of(1), pose_of(1), stamp_ns=1)
    known, unknown = (made.locate(cloud_of(i)).best.covariance for i in range(2))
    np.testing.assert_allclose(known[0, 0], 16.0 + 9.0)
    np.testing.assert_allclose(known[5, 5], 1.5**2 + 0.1)
    np.testing.assert_allclose(unknown[0, 0], 16.0)


def test_new_places_wait_until_enough_others_followed():
    made = recognizer(delay=3)
    for number in range(3):
        made.add(cloud_of(number), pose_of(number), stamp_ns=number)
        assert made.locate(cloud_of(number)).matches == ()
    made.add(cloud_of(3), pose_of(3), stamp_ns=3)
    assert [m.place_id for m in made.locate(cloud_of(3)).matches] == [0]
    assert (len(made), made.searchable) == (4, 1)


def test_numbers_are_given_or_counted_and_never_taken_twice():
    made = recognizer()
    assert made.add(cloud_of(0), pose_of(0), stamp_ns=0, id=40) == 40
    assert made.add(cloud_of(1), pose_of(1), stamp_ns=1) == 41
    with pytest.raises(DataError, match='place 40 is known already'):
        made.add(cloud_of(2), pose_of(2), stamp_ns=2, id=40)
    assert len(made) == 2


def test_corrected_poses_are_answered():
    made = filled(3)
    made.move({1: pose_of(9), 77: pose_of(1)})
    np.testing.assert_array_equal(made.locate(cloud_of(1)).best.T_map_base, pose_of(9))


def test_clouds_without_use_are_refused():
    made = filled(3)
    for broken in (np.empty((0, 3)), np.full((500, 3), np.nan), np.zeros((3, 3))):
        with pytest.raises(DataError, match='expected at least 50 points'):
            made.locate(PointCloud(broken.astype(np.float32)))
    partly = cloud_of(1).xyz.copy()
    partly[::10] = np.nan
    assert made.locate(PointCloud(partly)).best.place_id == 1


def test_a_saved_map_answers_the_same(tmp_path):
    made = filled(delay=4)
    spread = np.diag(np.arange(1.0, 7.0))
    made.add(cloud_of(30), pose_of(30), stamp_ns=30, id=30, covariance=spread)
    assert made.save(tmp_path / 'map') == tmp_path / 'map'
    loaded = recognizer(delay=4)
    assert loaded.load(tmp_path / 'map') == 21
    assert loaded.searchable == 21  # those that waited have waited long enough
    for number in (3, 19, 30):
        first, second = made.locate(cloud_of(number)), loaded.locate(cloud_of(number))
        assert second.best.place_id == number
        assert second.best.similarity == pytest.approx(1.0, abs=1e-3)
        if first.best.place_id == number:
            assert second.best.similarity == first.best.similarity
    np.testing.assert_array_equal(loaded.place(30).covariance, np.diag(np.arange(1.0, 7.0)))
    assert loaded.place(3).covariance is None
    np.testing.assert_allclose(loaded.cloud(3).xyz, made.cloud(3).xyz)
    assert loaded.next_id == 31
    loaded.save(tmp_path / 'map')  # over itself
    assert recognizer().load(tmp_path / 'map') == 21


def test_an_empty_map_can_be_saved(tmp_path):
    recognizer().save(tmp_path / 'map')
    assert recognizer().load(tmp_path / 'map') == 0


def test_another_ensemble_s_map_is_refused_and_nothing_changes(tmp_path):
    made = filled(2)
    made.fingerprint = 'f' * 64
    made.save(tmp_path / 'map')
    other = filled(3)
    with pytest.raises(MapError, match=r'described by another ensemble \(weights ffffffffffff, '):
        other.load(tmp_path / 'map')
    assert len(other) == 3


@pytest.mark.parametrize(
    ('damage', 'text'),
    [
        (lambda folder: (folder / 'places.npz').unlink(), 'missing'),
        (lambda folder: (folder / 'places.npz').write_bytes(b'PK\x03\x04 cut'), 'not readable'),
        (lambda folder: (folder / 'descriptors.npz').write_bytes(b''), 'index of places'),
        (lambda folder: (folder / 'clouds' / '000000.npz').unlink(), '2 clouds, got'),
        (lambda folder: (folder / 'meta.json').write_text('{'), 'not readable'),
        (lambda folder: (folder / 'meta.json').unlink(), 'expected the folder of saved places'),
        (lambda folder: (folder / 'meta.json').write_text('{"format": "lcd_map"}'), 'pose_graph'),
    ],
)
def test_a_damaged_map_is_refused(tmp_path, damage, text):
    filled(2).save(tmp_path / 'map')
    damage(tmp_path / 'map')
    with pytest.raises(MapError, match=text):
        recognizer().load(tmp_path / 'map')


def test_what_is_somebody_else_s_is_not_replaced(tmp_path):
    made = filled(2)
    (tmp_path / 'graph').mkdir()
    (tmp_path / 'graph' / 'meta.json').write_text(json.dumps({'format': 'lcd_map'}))
    with pytest.raises(MapError, match=r'a map of another kind \(lcd_map\)'):
        made.save(tmp_path / 'graph')
    (tmp_path / 'photos').mkdir()
    (tmp_path / 'photos' / 'cat.png').write_bytes(b'cat')
    with pytest.raises(MapError, match=r'cat\.png'):
        made.save(tmp_path / 'photos')
    with pytest.raises(MapError, match='empty path'):
        made.save('')


def test_a_pose_graph_does_not_replace_places(tmp_path):
    from lcd_loop_closure.map_folder import replaced

    filled(2).save(tmp_path / 'map')
    with pytest.raises(MapError, match=r'places\.npz'), replaced(tmp_path / 'map'):
        pass
    assert recognizer().load(tmp_path / 'map') == 2
