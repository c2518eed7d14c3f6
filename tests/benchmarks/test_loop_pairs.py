import numpy as np
import pytest

from bags.drives import open_drive
from bags.records import LidarScan
from benchmarks import loop_pairs
from lcd_common import se3
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pair_registration import PairRegistration


@pytest.fixture(scope='module')
def pairs():
    return PairRegistration()


@pytest.fixture(scope='module')
def kitti_00(real_data):
    return loop_pairs.kitti_00()


def test_scans_are_found_by_their_number(kitti_00):
    scans, T_world_base = kitti_00
    assert set(scans) == {*range(16), 52, 88, 94, 95, 198, 199, 850, 4501}
    metres, _ = se3.distance(T_world_base[52], T_world_base[4501])
    assert metres == pytest.approx(2.96, abs=0.02)


def test_the_true_pair_is_accepted_from_any_yaw(real_data, pairs):
    figures = loop_pairs.true_pair(pairs, yaws=4)
    assert figures['pair_accepted'] == 4
    assert figures['pair_translation_error_m'] < 0.35
    assert figures['pair_rotation_error_deg'] < 0.6


# The second to fourth lie 27 to 33 m apart in a street whose houses repeat themselves.
@pytest.mark.parametrize('numbers', [(88, 850), (88, 4501), (95, 4501), (52, 88), (0, 199)])
def test_different_places_of_a_town_are_rejected(kitti_00, pairs, numbers):
    scans, T_world_base = kitti_00
    away = np.linalg.norm(T_world_base[numbers[0]][:3, 3] - T_world_base[numbers[1]][:3, 3])
    assert away > loop_pairs.DIFFERENT_PLACE_M
    match, query = (loop_pairs.prepare(pairs, scans[i]) for i in numbers)
    assert pairs.compare(match, query).status is not LoopStatus.ACCEPTED


def test_different_towns_are_rejected(kitti_00, pairs, real_data):
    others = []
    for folder in ('kitti_360', 'argoverse2/7fab2350'):
        records = open_drive(real_data / folder).records(kinds=[LidarScan])
        others.append(loop_pairs.prepare(pairs, next(iter(records)).cloud))
    ours = loop_pairs.prepare(pairs, kitti_00[0][52])
    for match, query in ((ours, others[0]), (ours, others[1]), (others[0], others[1])):
        assert pairs.compare(match, query).status is not LoopStatus.ACCEPTED


def test_revisits_of_kitti_08(real_data, tmp_path):
    counted = loop_pairs.count_kitti_08(tmp_path)
    assert (counted['loops'], counted['pairs']) == (334, 2960)
