"""Find a kidnapped vehicle in a street, by true registrations of simulated sweeps."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_up_places import recognizer

from bags.street.drive import T_BASE_LIDAR, StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from lcd_common import se3
from uncertain_place_recognition.place import Match, PlaceAnswer
from uncertain_place_recognition.relocalizer import Relocalizer, RelocalizerConfig

PLACES = range(0, 60, 20)


@pytest.fixture(scope='module')
def street():
    drive = StreetDrive('loop', StreetConfig(), LidarConfig(point_time=False, columns=360))
    truth = drive.truth().T_world_body
    made = recognizer()
    seen = {}

    def cloud(step):
        if step not in seen:
            seen[step] = drive.scan(step).cloud.transformed(T_BASE_LIDAR)
        return seen[step]

    for id, step in enumerate(PLACES):
        made.add(
            np.ones((2, 16), np.float32),
            truth[step],
            stamp_ns=step,
            id=id,
            cloud=cloud(step),
            covariance=0.01 * np.eye(6),
        )
    return SimpleNamespace(recognizer=made, truth=truth, cloud=cloud)


def answer(*ids, accepted=True, withdrawn=None):
    matches = tuple(
        Match(id, np.eye(4), np.eye(6), 0.9, 0.1, 0.01, accepted and rank == 0)
        for rank, id in enumerate(ids)
    )
    return PlaceAnswer(matches, 0.1, 0.1, np.zeros(16), 3, withdrawn)


def test_two_scans_that_agree_say_where_the_vehicle_is(street):
    relocalizer = Relocalizer(street.recognizer)
    T_map_odom = street.truth[19]  # odometry begins there
    odometry = [se3.inverse(T_map_odom) @ street.truth[step] for step in (19, 22)]
    assert relocalizer.offer(answer(1), street.cloud(19), odometry[0]) is None
    found = relocalizer.offer(answer(1), street.cloud(22), odometry[1])
    assert found is not None and found.place_id == 1
    metres, radians = se3.distance(found.T_map_base, street.truth[22])
    assert metres < 0.2 and radians < 0.01
    np.testing.assert_allclose(found.T_map_odom @ odometry[1], found.T_map_base, atol=1e-9)
    assert se3.is_covariance(found.covariance)
    assert np.all(np.diag(found.covariance)[:3] > 0.01)  # the place's own is in it


def test_wrong_places_do_not_agree(street):
    relocalizer = Relocalizer(street.recognizer)
    for step in (19, 22):  # the same stretch, taken for another place
        T_odom_base = se3.inverse(street.truth[19]) @ street.truth[step]
        assert relocalizer.offer(answer(0), street.cloud(step), T_odom_base) is None


def test_while_the_guarantee_stands_only_accepted_matches_are_registered(street):
    relocalizer = Relocalizer(street.recognizer)
    relocalizer.offer(answer(1, 0, accepted=False), street.cloud(19), np.eye(4))
    assert relocalizer.registered == 0
    relocalizer.offer(answer(2, 0, withdrawn='drift'), street.cloud(19), np.eye(4))
    assert relocalizer.registered == 2
    one = Relocalizer(street.recognizer, RelocalizerConfig(tries=1, scans=1))
    assert one.offer(answer(1, 0, withdrawn='drift'), street.cloud(19), np.eye(4)) is not None
    assert one.registered == 1


def test_places_without_clouds_are_passed_over(street, tmp_path: Path):
    made = recognizer(keep_clouds=False)
    made.add(np.ones((2, 16), np.float32), np.eye(4), stamp_ns=0, cloud=street.cloud(0))
    relocalizer = Relocalizer(made)
    assert relocalizer.offer(answer(0), street.cloud(0), np.eye(4)) is None
    assert relocalizer.registered == 0
