"""Check where places of a drive come to lie, whatever the pose graph does with its keyframes."""

import numpy as np
import pytest
from made_up_places import cloud_of, pose_of, recognizer

from lcd_common import se3
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.reduction import ReductionConfig
from uncertain_place_recognition.drive_places import DrivePlaces, PlaceSpacingConfig
from uncertain_place_recognition.keyframe_poses import KeyframePoses
from uncertain_place_recognition.place import Place
from uncertain_place_recognition.scan_keyframes import KeyframeStamp, ScanKeyframes


def curve(number):
    """Keyframes on a circle, so that directions matter."""
    T = se3.rotation_z(0.1 * number)
    T[:3, 3] = [20 * np.sin(0.1 * number), 20 * (1 - np.cos(0.1 * number)), 0.0]
    return T


MOVED = se3.from_rotation_translation(se3.so3_exp([0, 0, 0.7]), [30.0, -5.0, 1.0])


def positions(ids, T_map_base):
    return GraphPositions(np.asarray(ids), np.array([T[:3, 3] for T in T_map_base]))


def test_poses_turn_with_the_graph():
    poses = KeyframePoses()
    for number in range(10):
        poses.add(number, number, curve(number))
        np.testing.assert_array_equal(poses.pose(number), curve(number))  # no graph yet
    moved = poses.corrected(positions(range(8), [MOVED @ curve(n) for n in range(8)]))
    assert sorted(moved) == list(range(8))
    for number in range(10):  # the graph does not know the last two yet
        np.testing.assert_allclose(poses.pose(number), MOVED @ curve(number), atol=1e-9)


def test_only_what_moved_is_corrected():
    poses = KeyframePoses()
    for number in range(5):
        poses.add(number, number, curve(number))
    truth = [curve(n) for n in range(5)]
    assert len(poses.corrected(positions(range(5), truth))) == 5
    assert poses.corrected(positions(range(5), truth)) == {}
    shifted = curve(3)
    shifted[0, 3] += 0.2
    assert list(poses.corrected(positions(range(5), [*truth[:3], shifted, truth[4]]))) == [3]
    assert poses.corrected(positions([77], [truth[0]])) == {}


def test_a_session_in_a_loaded_map_waits_until_the_graph_places_it():
    loaded = [Place(n, n, MOVED @ curve(n)) for n in range(6)]
    poses = KeyframePoses(loaded)
    poses.add(6, 6, np.eye(4))
    poses.add(7, 7, curve(1))
    assert poses.pose(6) is None and poses.pose(2) is None
    poses.corrected(positions(range(6), [place.T_map_base for place in loaded]))
    assert not poses.located
    both = [place.T_map_base for place in loaded] + [MOVED @ curve(6), MOVED @ curve(7)]
    moved = poses.corrected(positions(range(8), both))
    assert poses.located
    np.testing.assert_allclose(moved[7], MOVED @ curve(7), atol=1e-9)
    for place in loaded:  # each side is aligned for itself
        np.testing.assert_allclose(poses.pose(place.id), place.T_map_base, atol=1e-9)


def drive(made, **options):
    return DrivePlaces(made, None, ReductionConfig(), by_keyframes=False, **options)


def add(places, made, number, keyframe=None):
    pose = StampedPose(number, pose_of(number))
    return places.add(made.embed(cloud_of(number)), cloud_of(number), pose, keyframe)


def test_odometry_s_frame_is_the_map_s_in_a_new_map():
    made = recognizer()
    places = drive(made)
    assert add(places, made, 0) and add(places, made, 1)
    np.testing.assert_array_equal(made.place(1).T_map_base, pose_of(1))
    assert len(made.cloud(1)) > 0


def test_a_loaded_map_does_not_grow_before_the_vehicle_is_found(tmp_path):
    made = recognizer()
    add(drive(made), made, 0)
    made.save(tmp_path / 'map')
    made.load(tmp_path / 'map')
    places = drive(made)
    assert not add(places, made, 5)
    assert len(made) == 1
    assert places.T_map_base(pose_of(1), None) is None


def test_a_session_that_starts_again_is_noticed():
    made = recognizer()
    places = drive(made)
    add(places, made, 0, keyframe=4)
    add(places, made, 1, keyframe=5)
    assert [p.id for p in made.places()] == [4, 5]
    assert places.starts_again(0) and places.starts_again(5) and not places.starts_again(6)


def test_keyframes_nearer_than_the_spacing_are_no_places_but_keep_their_poses():
    made = recognizer()
    places = drive(made, spacing=PlaceSpacingConfig(distance=45.0))  # of places 30 m apart
    added = [add(places, made, number, keyframe=number) for number in range(4)]
    assert added == [True, False, True, False]
    np.testing.assert_array_equal(places.T_map_base(np.eye(4), 1), pose_of(1))
    places.force_next = True
    assert add(places, made, 4, keyframe=4)
    assert not add(places, made, 5, keyframe=5)


def test_scans_and_keyframes_meet_in_any_order():
    pairs = ScanKeyframes(scans=3, keyframes=2)
    first, second = (KeyframeStamp(n, 10 * n, np.eye(4)) for n in (1, 2))
    assert pairs.add_scan(10, 'a') is None
    assert pairs.add_keyframe(first) == ('a', first)
    assert pairs.add_keyframe(second) is None
    assert pairs.add_scan(20, 'b') == ('b', second)
    for stamp in range(100, 104):
        pairs.add_scan(stamp, stamp)
    assert pairs.add_keyframe(KeyframeStamp(5, 100, np.eye(4))) is None  # its scan is gone
    for number in range(3):
        pairs.add_keyframe(KeyframeStamp(number, number, np.eye(4)))
    assert pairs.lost == 2


@pytest.mark.parametrize('members', [1, 5])
def test_hashes_tell_weights_apart(members):
    import torch

    from uncertain_place_recognition.weights_hash import weights_hash

    nets = [torch.nn.Linear(3, 2) for _ in range(members)]
    whole = weights_hash(nets)
    assert weights_hash(nets) == whole and len(whole) == 64
    with torch.no_grad():
        nets[-1].bias[0] += 1e-3
    assert weights_hash(nets) != whole
