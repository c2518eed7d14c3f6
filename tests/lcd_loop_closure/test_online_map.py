"""Keyframes and loops in any order make the graph that they make in order; sessions find a map."""

from collections import Counter

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.gnss import GnssFix
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig
from lcd_loop_closure.graph_settings import GraphSettings
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.online_map import OnlineMap, OnlineMapConfig
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig
from lcd_loop_closure.session_anchor import AnchorConfig

COUNT = 24
MOTION = np.diag([1e-3, 1e-3, 1e-4, 1e-6, 1e-6, 1e-5])
LOOP = np.diag([1e-3] * 3 + [1e-5] * 3)
TRUTH = [
    se3.from_rotation_translation(
        se3.so3_exp([0, 0, a]), [20 * np.sin(a), 20 * (1 - np.cos(a)), 0.0]
    )
    for a in np.arange(COUNT) * 2 * np.pi / (COUNT - 4)
]


def _online(count: Counter[str] | None = None, **settings: int) -> OnlineMap:
    counts = Counter() if count is None else count

    def note(cause: str) -> None:
        counts[cause] += 1

    return OnlineMap(OnlineMapConfig(**settings), GraphSettings(), AnchorConfig(), note)


def _keyframes(
    first_id: int = 0, T_odom_start: np.ndarray | None = None, stamp_ns: int = 0
) -> list[Keyframe]:
    """Drive the circle with an odometry that turns too little."""
    random = np.random.default_rng(3)
    T = np.eye(4) if T_odom_start is None else T_odom_start
    keyframes = []
    for k in range(COUNT):
        motion = np.eye(4)
        if k:
            error = [0.0, 0.0, 0.0, 0.0, 0.0, 0.004]
            motion = se3.inverse(TRUTH[k - 1]) @ TRUTH[k] @ se3.exp(error)
        T = T @ motion
        cloud = PointCloud(random.normal(size=(30, 3)).astype(np.float32))
        keyframes.append(
            Keyframe(first_id + k, stamp_ns + 1000 * (k + 1), T, motion, MOTION if k else None,
                     cloud, np.ones(4, np.float32) * k, 'scan_context')
        )  # fmt: skip
    return keyframes


def _loop(match: int, query: int, match_id: int | None = None, offset: int = 0) -> LoopConstraint:
    return LoopConstraint(
        match if match_id is None else match_id,
        query + offset,
        1000 * (match + 1),
        1000 * (query + 1),
        se3.inverse(TRUTH[match]) @ TRUTH[query],
        LOOP,
        method='test',
    )


LOOPS = [(0, 20), (1, 21), (2, 22), (3, 23)]


def _built(online: OnlineMap, loops_first: bool = False) -> np.ndarray:
    loops = [_loop(*pair) for pair in LOOPS]
    if loops_first:
        for loop in loops:
            assert online.add_loop(loop) == 'waits'
    for keyframe in _keyframes():
        online.add_keyframe(keyframe)
        online.graph.update()
    if not loops_first:
        for loop in loops:
            assert online.add_loop(loop) == 'in'
    online.graph.update()
    solver = RobustSolver(RobustSolverConfig())
    for _ in range(2):  # as the node has it: the verdict's poses come with the verdict
        online.graph.apply(solver.solve(online.graph.snapshot()))
    return np.array(online.graph.poses())


def test_loops_that_come_before_their_keyframes_wait_for_them() -> None:
    in_order, early = _built(_online()), _built(_online(), loops_first=True)
    error = np.linalg.norm(in_order[:, :3, 3] - early[:, :3, 3], axis=1)
    assert error.max() < 0.05
    truth = np.array([se3.inverse(TRUTH[0]) @ T for T in TRUTH])
    assert np.linalg.norm(in_order[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.5
    odometry = np.array([k.T_odom_base for k in _keyframes()])
    assert np.linalg.norm(odometry[:, :3, 3] - truth[:, :3, 3], axis=1).max() > 1.0


def test_waiting_loops_are_bounded() -> None:
    counts: Counter[str] = Counter()
    online = _online(counts, waiting_loops=3)
    for query in range(1, 11):
        online.add_loop(_loop(0, query))
    assert counts['dropped loops: keyframe did not come'] == 7
    for keyframe in _keyframes():
        online.add_keyframe(keyframe)
    online.graph.update()
    assert [loop.query_id for loop in online.graph.loops()] == [8, 9, 10]


def test_loops_without_their_keyframe_or_transform_are_left_out_and_counted() -> None:
    counts: Counter[str] = Counter()
    online = _online(counts)
    for keyframe in _keyframes():
        if keyframe.id != 7:
            online.add_keyframe(keyframe)
    assert counts == {'keyframes missed': 1}
    assert online.add_loop(_loop(7, 20)) == 'unknown keyframe'
    with pytest.raises(DataError, match='without transform'):
        online.add_loop(LoopConstraint(0, 20, 0, 0))
    rejected = LoopConstraint(0, 20, 0, 0, status=LoopStatus.REJECTED_FITNESS)
    assert online.add_loop(rejected) == 'remembered'
    assert list(online.candidates) == [rejected]
    assert online.graph.loops() == []


def test_ids_must_increase() -> None:
    online = _online()
    keyframes = _keyframes()
    online.add_keyframe(keyframes[0])
    online.add_keyframe(keyframes[1])
    with pytest.raises(DataError, match='expected a keyframe with the id 2 or more, got 1'):
        online.add_keyframe(keyframes[1])
    assert online.starts_again(keyframes[0])
    assert not online.starts_again(keyframes[2])


def test_a_saved_map_goes_on_with_the_same_estimate() -> None:
    online = _online()
    poses = _built(online)
    other = _online()
    other.load(online.saved())
    # iSAM2 starts afresh around these poses: what it had not relinearized yet moves by millimetres.
    np.testing.assert_allclose(other.graph.poses(), poses, atol=5e-3)
    assert [loop.status for loop in other.graph.loops()] == [
        loop.status for loop in online.graph.loops()
    ]
    assert other.nbytes == online.nbytes
    np.testing.assert_array_equal(other.points_of(5), online.points_of(5))


@pytest.mark.parametrize('stamp_ns', [10**9, -(10**9)])
def test_a_new_session_waits_until_two_loops_agree_and_then_lies_in_the_map(stamp_ns: int) -> None:
    online = _online()
    _built(online)
    online.load(online.saved())
    assert not online.located and online.T_map_odom is None
    before = np.array(online.graph.poses())
    elsewhere = se3.exp([300.0, -50.0, 2.0, 0.0, 0.0, 2.0])  # where the new odometry starts
    session = _keyframes(COUNT, elsewhere, stamp_ns)
    for keyframe in session[:4]:
        online.add_keyframe(keyframe)
    assert len(online.graph) == COUNT
    assert online.add_loop(_loop(2, 1, offset=COUNT)) == 'waits'  # the session's own 1 at old 2
    assert not online.located
    assert online.add_loop(_loop(3, 3, offset=COUNT)) == 'in'
    assert online.located
    online.graph.update()
    for keyframe in session[4:]:
        online.add_keyframe(keyframe)
        online.graph.update()
    assert len(online.graph) == 2 * COUNT
    T_map_first = online.graph.poses()[COUNT]
    metres, radians = se3.distance(before[0], T_map_first)
    assert metres < 0.5 and radians < 0.05
    # The old map does not move for it.
    assert np.abs(online.graph.poses()[:COUNT, :3, 3] - before[:, :3, 3]).max() < 0.3
    T_map_odom = online.T_map_odom
    assert T_map_odom is not None
    metres, _ = se3.distance(online.graph.poses()[-1], T_map_odom @ session[-1].T_odom_base)
    assert metres < 1e-9
    # And it can be saved and loaded once more.
    again = _online()
    again.load(online.saved())
    assert again.first_id == 2 * COUNT


def test_a_person_may_say_where_a_session_is() -> None:
    online = _online()
    _built(online)
    online.load(online.saved())
    for keyframe in _keyframes(COUNT)[:3]:
        online.add_keyframe(keyframe)
    T_map_odom = se3.exp([1.0, 2.0, 0, 0, 0, 0.3])
    online.place(T_map_odom)
    online.graph.update()
    assert online.located
    expected = T_map_odom @ _keyframes(COUNT)[0].T_odom_base
    metres, radians = se3.distance(online.graph.poses()[COUNT], expected)
    assert metres < 1e-6 and radians < 1e-6


def test_a_session_that_is_never_found_stays_bounded() -> None:
    counts: Counter[str] = Counter()
    online = _online(counts, unplaced_keyframes=5)
    _built(online)
    online.load(online.saved())
    for keyframe in _keyframes(COUNT):
        online.add_keyframe(keyframe)
    assert counts['dropped keyframes: session not found in the map'] == COUNT - 5
    online.place(np.eye(4))  # found late: the rest of the session is attached, gap or not
    online.graph.update()
    assert len(online.graph) == COUNT + 5
    expected = _keyframes(COUNT)[COUNT - 5].T_odom_base
    assert se3.distance(online.graph.poses()[COUNT], expected)[0] < 1e-6


def test_a_loop_by_hand_and_a_fix_need_their_keyframes() -> None:
    online = _online()
    fix = GnssFix(0, 49.0, 8.4, 110.0, np.eye(3))
    with pytest.raises(DataError, match='before the first keyframe'):
        online.add_gnss(fix, np.eye(4), np.eye(4))
    for keyframe in _keyframes():
        online.add_keyframe(keyframe)
    with pytest.raises(DataError, match='expected a loop between'):
        online.add_loop_by_hand(0, 99, np.eye(4), LOOP)
    online.add_loop_by_hand(0, 20, se3.inverse(TRUTH[0]) @ TRUTH[20], LOOP)
    online.graph.update()
    assert [loop.method for loop in online.graph.loops()] == ['by hand']
    online.add_gnss(fix, np.eye(4), _keyframes()[-1].T_odom_base)
    assert online.graph.snapshot().gnss[0].keyframe_id == COUNT - 1


def test_the_pose_grows_less_certain_since_the_last_keyframe() -> None:
    online = _online()
    for keyframe in _keyframes():
        online.add_keyframe(keyframe)
    online.graph.update()
    noise = GraphNoise(GraphNoiseConfig())
    last = _keyframes()[-1]
    at_keyframe = StampedPose(last.stamp_ns, last.T_odom_base, np.eye(6) * 1e-6)
    corrected = online.corrected_pose((last.id, at_keyframe))
    motion = se3.exp([1.5, 0, 0, 0, 0, 0.1])
    added = np.diag([1e-2] * 3 + [1e-4] * 3)
    now = StampedPose(
        last.stamp_ns + 10,
        last.T_odom_base @ motion,
        se3.compose_covariance(np.eye(6) * 1e-6, motion, added),
    )
    T_map_base, covariance = corrected.at(now, noise)
    np.testing.assert_allclose(T_map_base, online.graph.poses()[-1] @ motion, atol=1e-9)
    expected = se3.compose_covariance(
        online.graph.covariance(last.id), motion, noise.odometry(motion, added)
    )
    assert covariance is not None
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)
    # Odometry of another keyframe's time says nothing about the motion since this one.
    stale = online.corrected_pose((last.id - 1, at_keyframe))
    assert stale.keyframe.covariance is None
