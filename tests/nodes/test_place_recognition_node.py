"""Feed place_recognition by hand and read what it publishes."""

import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from diagnostic_msgs.msg import DiagnosticStatus
from place_feed import SPACING, Fed, fed_by
from std_srvs.srv import Trigger

from lcd_common import se3
from lcd_common.errors import ConfigError, MapError
from lcd_common.nodes import messages
from lcd_msgs.msg import PlaceMatchArray
from uncertain_place_recognition.nodes.declared_recognizer import warn_of_spacing
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode
from uncertain_place_recognition.place import Judgement
from uncertain_place_recognition.relocalizer import Relocalized

pytestmark = pytest.mark.ros


@pytest.fixture
def fed(make: Callable[..., Any], small_weights: Path) -> Callable[..., Fed]:
    """Make a fed node with small weights."""
    return fed_by(make, small_weights)


class Vouching:
    """Judge that accepts what looks exactly the same."""

    metric, matches, spacing_m = 'cosine', 5, None
    withdrawn: str | None = None

    def reset(self) -> None:
        """Nothing is remembered."""

    def judge(self, neighbours: Any, positions: Any, uncertainty: float, size: int) -> Judgement:
        """Accept a similarity of one."""
        same = bool(len(neighbours)) and bool(neighbours.similarity[0] > 0.9999)
        accepted = same and self.withdrawn is None
        return Judgement(0.01 if same else 0.6, accepted, self.withdrawn)


def test_every_chosen_scan_is_answered_with_what_came_before(fed: Callable[..., Fed]) -> None:
    made = fed()
    for step in range(5):
        made.step(step)
    assert [len(m.matches) for m in made.answers] == [0, 1, 2, 3, 4]
    assert [messages.stamp_ns(m.header.stamp) for m in made.answers] == [
        drive.stamp(step) for step in range(5)
    ]
    assert made.answers[0].header.frame_id == 'lidar'
    made.step(60, seen=2)
    best = made.answers[-1].matches[0]
    assert best.place_id == 2
    assert best.similarity == pytest.approx(1.0, abs=1e-3)
    assert best.uncertainty > 0
    assert np.isnan(best.false_match_probability) and not best.accepted
    pose, covariance = messages.from_pose_with_covariance(best.pose)
    np.testing.assert_allclose(pose, drive.true_pose(2), atol=1e-6)
    assert covariance is not None and 25.0 < covariance[0, 0] < 26.0  # 5 m, and odometry's own
    status = made.node.diagnostics.status()
    assert status.level == DiagnosticStatus.WARN
    assert 'nothing is calibrated' in status.message
    assert made.counted('places added') == 6


def test_places_keep_their_distance_and_wait(fed: Callable[..., Fed]) -> None:
    made = fed(asked__distance=2.5, places__distance=2.5, recognizer__delay=2)
    for step in range(13):
        made.step(step)
    assert len(made.answers) == 5  # steps 0 3 6 9 12
    assert [len(m.matches) for m in made.answers] == [0, 0, 0, 1, 2]


def test_what_a_judge_says_is_published(fed: Callable[..., Fed]) -> None:
    made = fed()
    judge = made.node.recognizer._judge = Vouching()
    made.step(0)
    made.step(1, seen=0)
    made.step(2)
    accepted, rejected = (m.matches[0] for m in made.answers[1:])
    assert accepted.accepted and accepted.false_match_probability == pytest.approx(0.01)
    assert not rejected.accepted and rejected.false_match_probability == pytest.approx(0.6)
    assert made.node.diagnostics.status().level == DiagnosticStatus.OK
    judge.withdrawn = 'the map is too large'
    made.step(3, seen=0)
    withdrawn = made.answers[-1].matches[0]
    assert not withdrawn.accepted and np.isnan(withdrawn.false_match_probability)
    assert 'no guarantee: the map is too large' in made.node.diagnostics.status().message
    assert made.counted('answers accepted') == made.counted('answers rejected') == 1
    assert made.counted('answers without guarantee') == 1
    colors = [m.markers[0].color for m in made.markers[1:]]
    assert colors[0].g > 0.7 and colors[1].r > 0.8 and colors[2].r == colors[2].g


def test_broken_input_is_counted_and_survived(fed: Callable[..., Fed]) -> None:
    made = fed(waiting_clouds=10)
    made.step(0)
    broken = drive.odom_message(1)
    broken.pose.pose.position.x = float('nan')
    made.lockstep.feed('/odom', broken)
    assert made.counted('rejected odom: broken') == 1
    nameless = drive.scan(1)
    nameless.fields[0].name = 'range'
    made.lockstep.feed('/points', nameless)
    made.lockstep.feed('/odom', drive.odom_message(1))
    assert made.counted('rejected points: broken') == 1
    empty = drive.scan(2)
    empty.width, empty.row_step, empty.data = 0, 0, empty.data[:0]
    made.lockstep.feed('/points', empty)
    made.lockstep.feed('/odom', drive.odom_message(2))
    assert made.counted('rejected points: no submap') == 1
    partly = drive.scan(3)
    values = np.frombuffer(bytes(partly.data), np.float32).copy().reshape(partly.width, -1)
    values[::10, 0] = np.nan
    partly.data = values.tobytes()
    made.lockstep.feed('/points', partly)
    made.lockstep.feed('/odom', drive.odom_message(3))
    assert made.counted('points without coordinates') == 300
    made.step(3)
    assert made.counted('rejected points: duplicate stamp') == 1
    assert len(made.answers) == 2
    for step in range(4, 20):  # odometry is gone
        made.lockstep.feed('/points', drive.scan(step, count=40))
    assert made.counted('rejected points: odometry did not come') == 6


def test_without_the_transform_nothing_is_guessed(fed: Callable[..., Fed]) -> None:
    made = fed(transform=False)
    made.step(0)
    assert made.answers == []
    assert made.counted('rejected points: no transform') == 1
    assert made.node.diagnostics.status().level == DiagnosticStatus.ERROR
    made.lockstep.feed('/tf_static', drive.static_transform())
    made.step(1)
    assert len(made.answers) == 1


def test_a_looped_bag_starts_again(fed: Callable[..., Fed]) -> None:
    made = fed()
    for _ in range(2):
        for step in range(40):
            made.step(step, count=1500)
    assert [len(m.matches) for m in made.answers] == [*range(5), *[5] * 35] * 2
    assert made.counted('clock jumps in odom') == 1


def test_maps_are_saved_and_loaded_by_services(fed: Callable[..., Fed], tmp_path: Path) -> None:
    made = fed()
    assert 'no place yet' in made.save(tmp_path / 'map').message
    for step in range(4):
        made.step(step)
    answer = made.save(tmp_path / 'map')
    assert answer.success and answer.message.startswith('4 places saved in')
    (tmp_path / 'mine.txt').write_text('precious')
    answer = made.save(tmp_path)
    assert not answer.success and 'no part of a map' in answer.message
    for path in ('', tmp_path):
        assert not made.load(path).success
    assert len(made.node.recognizer) == 4  # a map that cannot be loaded costs nothing

    later = fed(map=str(tmp_path / 'map'))
    later.step(20, seen=3)
    assert later.answers[0].matches[0].place_id == 3
    later.step(21)
    assert later.counted('scans that are no places') == 2
    assert len(later.node.recognizer) == 4
    assert later.load(tmp_path / 'map').message.startswith('4 places loaded')
    with pytest.raises(MapError, match='expected the folder of saved places'):
        fed(map=str(tmp_path))


def test_a_place_is_added_by_hand(fed: Callable[..., Fed]) -> None:
    made = fed(grow=False, asked__distance=50.0)
    made.step(0)
    made.step(1)
    assert len(made.node.recognizer) == 0
    answer = made.service('on_add_place', Trigger.Request(), Trigger.Response())
    assert answer.success
    made.step(2)
    made.step(3)
    (place,) = made.node.recognizer.places()
    assert place.stamp_ns == drive.stamp(2)
    assert made.service('on_reset', Trigger.Request(), Trigger.Response()).success
    assert len(made.node.recognizer) == 0


def test_relocalization_publishes_one_initial_pose(
    fed: Callable[..., Fed], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = fed()
    for step in range(3):
        made.step(step)
    made.save(tmp_path / 'map')
    later = fed(map=str(tmp_path / 'map'), relocalize=True)
    T_map_odom = se3.from_rotation_translation(se3.so3_exp([0, 0, 1.0]), [3.0, 4.0, 0.0])
    offered: list[int] = []

    def offer(self: Any, answer: Any, cloud: Any, T_odom_base: Any) -> Relocalized | None:
        offered.append(len(answer.matches))
        if len(offered) < 3:
            return None
        return Relocalized(T_map_odom, T_map_odom @ T_odom_base, 0.01 * np.eye(6), 2)

    monkeypatch.setattr('uncertain_place_recognition.relocalizer.Relocalizer.offer', offer)
    for step in range(20, 22):
        later.step(step)
    assert 'looking for the vehicle' in later.node.diagnostics.status().message
    for step in range(22, 26):
        later.step(step)
    (pose,) = later.poses
    assert len(offered) == 3
    assert pose.header.frame_id == 'map'
    assert messages.stamp_ns(pose.header.stamp) == drive.stamp(22)
    T_map_base, covariance = messages.from_pose_with_covariance(pose.pose)
    np.testing.assert_allclose(T_map_base, T_map_odom @ drive.odometry_pose(22), atol=1e-6)
    np.testing.assert_allclose(covariance, 0.01 * np.eye(6), atol=1e-9)
    assert later.counted('places added') == 4  # from then on the map grows
    np.testing.assert_allclose(
        later.node.recognizer.places()[-1].T_map_base,
        T_map_odom @ drive.odometry_pose(25),
        atol=1e-6,
    )
    assert later.service('on_relocalize', Trigger.Request(), Trigger.Response()).success
    later.step(26)
    assert len(later.poses) == 2


def test_a_slow_machine_drops_the_oldest_scan(
    make: Callable[..., Any],
    small_weights: Path,
    spin_until: Callable[..., bool],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = make(PlaceRecognitionNode, weights=str(small_weights), waiting_scans=2, **SPACING)
    free, asked = threading.Event(), []
    embed = node.recognizer.embed

    def slow(cloud: Any) -> Any:
        asked.append(len(cloud))
        free.wait(20.0)
        return embed(cloud)

    monkeypatch.setattr(node.recognizer, 'embed', slow)
    answers: list[PlaceMatchArray] = []
    node.create_subscription(PlaceMatchArray, 'place_matches', answers.append, 10)
    node._transforms.on_tf_static(drive.static_transform())
    for step in range(6):
        node.on_points(drive.scan(step))
        node.on_odom(drive.odom_message(step))
        assert spin_until([node], lambda: len(asked) == 1)
    assert node.diagnostics.counted('dropped scans: machine too slow') == 3
    free.set()
    assert spin_until([node], lambda: len(answers) == 3)
    assert [messages.stamp_ns(m.header.stamp) for m in answers] == [
        drive.stamp(step) for step in (0, 4, 5)
    ]


def test_namespaces_and_remaps(make: Callable[..., Any], small_weights: Path) -> None:
    remap = ['--ros-args', '-r', 'points:=/velodyne_points']
    options = {'threaded': False, 'weights': str(small_weights), 'follow': 'keyframes'}
    node = make(PlaceRecognitionNode, namespace='car', cli_args=remap, **options)
    names = {s.topic_name for s in node.subscriptions}
    assert {'/velodyne_points', '/car/odom', '/car/keyframe', '/car/graph/keyframes'} <= names
    published = {p.topic_name for p in node.publishers}
    assert {'/car/place_matches', '/car/initialpose', '/car/place_markers'} <= published
    services = {s.srv_name for s in node.services}
    wanted = {'add_place', 'save_map', 'load_map', 'relocalize', 'reset'}
    assert wanted <= {name.rsplit('/', 1)[-1] for name in services}


def test_wrong_parameters_are_named(
    make: Callable[..., Any], small_weights: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match='follow must be one of odom, keyframes'):
        make(PlaceRecognitionNode, follow='gps', weights=str(small_weights))
    with pytest.raises(ConfigError, match='nowhere does not exist: train an ensemble'):
        make(PlaceRecognitionNode, weights=str(tmp_path / 'nowhere'))
    with pytest.raises(MapError, match='no readable calibration'):
        make(PlaceRecognitionNode, weights=str(small_weights), calibration=str(tmp_path / 'no'))


def test_help_names_topics_and_services() -> None:
    code = (
        'from uncertain_place_recognition.nodes.place_recognition_node import main;'
        'raise SystemExit(main())'
    )
    run = subprocess.run(
        [sys.executable, '-c', code, '--help'], capture_output=True, text=True, check=True
    )
    for word in ('Subscribes', 'Publishes', 'Services', 'place_matches', '~/load_map', 'ros2 run'):
        assert word in run.stdout


def test_places_much_closer_than_the_calibration_s_are_warned_of(
    fed: Callable[..., Fed], capfd: pytest.CaptureFixture[str]
) -> None:
    node = fed(asked__distance=1.0, places__distance=1.0).node
    assert node.recognizer.calibrated_spacing_m is None
    judge = Vouching()
    judge.spacing_m = 10.2  # type: ignore[assignment]
    node.recognizer._judge = judge
    capfd.readouterr()
    warn_of_spacing(node, node.recognizer, 9.0)
    assert 'places.distance' not in capfd.readouterr().err
    warn_of_spacing(node, node.recognizer, 3.0)
    assert (
        'places.distance is 3 m, the calibration had a place every 10.2 m' in capfd.readouterr().err
    )
