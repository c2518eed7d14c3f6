"""A session is attached where loops agree, and never by one loop or by wrong ones."""

import numpy as np

from lcd_common import se3
from lcd_loop_closure.session_anchor import AnchorConfig, SessionAnchor

T_MAP_ODOM = se3.exp([120.0, -40.0, 1.0, 0.0, 0.02, 2.5])


def _odometry(k: int) -> np.ndarray:
    return se3.exp([2.0 * k, 0.1 * k, 0.0, 0.0, 0.0, 0.02 * k])


def _add(anchor: SessionAnchor, k: int, error: np.ndarray) -> np.ndarray | None:
    T_map_match = se3.exp(np.array([k, 2.0, 0, 0, 0, 0.3 * k]))
    T_match_query = se3.inverse(T_map_match) @ T_MAP_ODOM @ _odometry(k) @ error
    return anchor.add(k, T_map_match, T_match_query, _odometry(k))


def test_two_loops_that_agree_attach_it_within_their_noise() -> None:
    random = np.random.default_rng(0)
    anchor = SessionAnchor(AnchorConfig())
    assert _add(anchor, 3, se3.exp(random.normal(size=6) * 0.01)) is None
    found = _add(anchor, 5, se3.exp(random.normal(size=6) * 0.01))
    assert found is not None
    metres, radians = se3.distance(found @ _odometry(5), T_MAP_ODOM @ _odometry(5))
    assert metres < 0.1 and radians < 0.1


def test_the_same_keyframe_twice_is_one_opinion() -> None:
    anchor = SessionAnchor(AnchorConfig())
    assert _add(anchor, 3, np.eye(4)) is None
    assert _add(anchor, 3, np.eye(4)) is None


def test_wrong_loops_do_not_agree_by_chance_and_do_not_stand_in_the_way() -> None:
    random = np.random.default_rng(1)
    anchor = SessionAnchor(AnchorConfig())
    assert _add(anchor, 0, np.eye(4)) is None
    for k in range(1, 40):
        wrong = se3.exp(np.r_[random.uniform(5, 60, 3), 0, 0, random.uniform(-3, 3)])
        assert _add(anchor, k, wrong) is None
    assert _add(anchor, 41, np.eye(4)) is not None


def test_memory_is_bounded() -> None:
    anchor = SessionAnchor(AnchorConfig(loops=1000))
    for k in range(200):
        _add(anchor, k, np.eye(4))
    assert len(anchor._guesses) == SessionAnchor.kept
