from contextlib import contextmanager

import numpy as np
import pytest
from simulated_street import relative, street, view

from lcd_common import se3
from lcd_loop_closure.descriptor_choice import DescriptorConfig
from lcd_loop_closure.keyframes import Keyframe, KeyframeConfig, KeyframeSelector
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.loop_detector import (
    LoopDetector,
    LoopDetectorConfig,
    LoopDetectorSettings,
)
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.scan_context import ScanContextConfig

SWEEPS = {}


def drive(detector, every_m=8.0):
    """Keyframes of the simulated drive; their ids and the sweeps that they come from."""
    truth = street().truth()
    selector = KeyframeSelector(KeyframeConfig(distance=every_m, angle=3.1))
    keyframes = []
    for sweep, T in enumerate(truth.T_world_body):
        if not selector.due(T):
            continue
        selector.take(T)
        seen = view(sweep)
        motion = se3.inverse(keyframes[-1].T_odom_base) @ T if keyframes else np.eye(4)
        keyframe = Keyframe(
            id=len(keyframes),
            stamp_ns=int(truth.stamps_ns[sweep]),
            T_odom_base=T,
            T_previous_this=motion,
            motion_covariance=None,
            cloud=seen.reduced,
            descriptor=detector.describe(seen.cloud),
            descriptor_method=detector.descriptor_method,
        )
        keyframes.append(keyframe)
        SWEEPS[keyframe.id] = sweep
    return keyframes


def settings(max_distance=0.5, **values):
    """Scan Context's: these tests are of the stages, whatever describes."""
    return LoopDetectorSettings(
        detector=LoopDetectorConfig(**values),
        descriptor=DescriptorConfig(method='scan_context'),
        scan_context=ScanContextConfig(max_distance=max_distance),
    )


@pytest.fixture(scope='module')
def keyframes():
    return drive(LoopDetector(settings()))


@pytest.fixture(scope='module')
def by_descriptor(keyframes):
    detector = LoopDetector(settings(by_radius=False))
    return [detector.process(keyframe) for keyframe in keyframes]


def positions(keyframes):
    return np.array([keyframe.T_odom_base[:3, 3] for keyframe in keyframes])


def revisits(keyframes, within_m, delay_m=30.0):
    """Ids of keyframes that pass an earlier one again."""
    xyz = positions(keyframes)
    path = np.r_[0, np.cumsum(np.linalg.norm(np.diff(xyz, axis=0), axis=1))]
    away = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1)
    earlier = path[:, None] - path[None] > delay_m + 10.0
    return np.flatnonzero(np.any((away <= within_m) & earlier, axis=1))


def accepted(loops):
    return {loop.query_id: loop for candidates in loops for loop in candidates if loop.accepted}


def test_revisits_are_found_by_descriptor_and_no_loop_is_wrong(keyframes, by_descriptor):
    found = accepted(by_descriptor)
    expected = revisits(keyframes, within_m=3.0)
    assert len(expected) > 8
    assert sum(id in found for id in expected) >= 0.9 * len(expected)
    for loop in found.values():
        match, query = (view(SWEEPS[i]) for i in (loop.match_id, loop.query_id))
        metres, radians = se3.distance(relative(match, query), loop.T_match_query)
        assert metres < 0.1 and np.degrees(radians) < 0.2
        assert loop.method == 'scan_context+bev+gicp'
        assert loop.fitness > 0.3 and loop.overlap > 0.25 and loop.inliers > 100
        assert loop.match_stamp_ns < loop.query_stamp_ns


def test_both_directions_are_among_them(keyframes, by_descriptor):
    turned = [abs(se3.yaw(loop.T_match_query)) for loop in accepted(by_descriptor).values()]
    assert max(turned) > 3.0 and min(turned) < 0.2


def test_the_search_ends_with_the_first_accepted_candidate(by_descriptor):
    for candidates in by_descriptor:
        assert len(candidates) <= 3
        assert not any(loop.accepted for loop in candidates[:-1])
        assert len({loop.match_id for loop in candidates}) == len(candidates)
        assert all(loop.reason for loop in candidates)


def test_radius_alone_finds_them_by_odometry_and_by_the_graph(keyframes):
    expected = revisits(keyframes, within_m=3.0)
    detector = LoopDetector(settings(by_descriptor=False))
    for keyframe in keyframes[: expected[0]]:
        detector.remember(keyframe)
    found = accepted([detector.process(keyframe) for keyframe in keyframes[expected[0] :]])
    assert sum(id in found for id in expected) >= 0.9 * len(expected)
    assert all(loop.method == 'radius+bev+gicp' for loop in found.values())
    assert all(loop.descriptor_distance is None for loop in found.values())
    # A graph that lays the drive out elsewhere has no neighbours to offer.
    query = keyframes[int(expected[-1])]
    apart = GraphPositions(
        np.arange(query.id), np.arange(query.id)[:, None] * np.array([[1000.0, 0, 0]])
    )
    detector = LoopDetector(settings(by_descriptor=False))
    for keyframe in keyframes[: query.id]:
        detector.remember(keyframe)
    assert detector.process(query, apart) == []


def test_descriptors_that_differ_too_much_are_not_registered(keyframes):
    detector = LoopDetector(settings(by_radius=False, max_distance=0.0))
    loops = [loop for keyframe in keyframes[:30] for loop in detector.process(keyframe)]
    assert loops
    assert {loop.status for loop in loops} == {LoopStatus.REJECTED_DESCRIPTOR}
    assert all('exceeds 0' in loop.reason and loop.T_match_query is None for loop in loops)


def test_a_gate_vetoes_with_its_own_reason(keyframes):
    asked = []

    def gate(query, match):
        asked.append((query.id, match.id))
        return 'too uncertain: 0.9 exceeds 0.5'

    detector = LoopDetector(settings(by_radius=False, max_distance=2.0), gate=gate)
    loops = [loop for keyframe in keyframes[:30] for loop in detector.process(keyframe)]
    assert [(loop.query_id, loop.match_id) for loop in loops] == asked
    assert {loop.status for loop in loops} == {LoopStatus.REJECTED_UNCERTAIN}
    assert {loop.reason for loop in loops} == {'too uncertain: 0.9 exceeds 0.5'}


def test_a_gate_is_not_asked_of_what_lies_near_by_the_graph(keyframes):
    query = keyframes[int(revisits(keyframes, within_m=3.0)[-1])]
    gated = LoopDetector(settings(by_descriptor=False), gate=lambda query, match: 'no')
    for keyframe in keyframes[: query.id]:
        gated.remember(keyframe)
    assert [loop.status for loop in gated.process(query)][-1] is LoopStatus.ACCEPTED


def test_a_loaded_map_is_searched_at_once(keyframes):
    detector = LoopDetector(settings())
    detector.restore(keyframes[:-1])
    assert detector.size == len(keyframes) - 1
    last = keyframes[-1]
    nearby = np.argmin(np.linalg.norm(positions(keyframes[:-1]) - last.T_odom_base[:3, 3], axis=1))
    loops = detector.process(last)
    assert loops[-1].accepted
    assert abs(loops[-1].match_id - nearby) <= 3


def test_what_is_forgotten_is_no_candidate(keyframes, by_descriptor):
    loop = next(iter(accepted(by_descriptor).values()))
    detector = LoopDetector(settings(by_radius=False, spread=0.0))
    for keyframe in keyframes[: loop.query_id]:
        detector.remember(keyframe)
    detector.forget(loop.match_id)
    detector.forget(9999)
    assert detector.size == loop.query_id - 1
    candidates = detector.process(keyframes[loop.query_id])
    assert loop.match_id not in {candidate.match_id for candidate in candidates}
    detector.reset()
    assert detector.size == 0
    assert detector.process(keyframes[-1]) == []


def test_the_same_drive_gives_the_same_loops(keyframes, by_descriptor):
    detector = LoopDetector(settings(by_radius=False))
    start = min(accepted(by_descriptor)) - 2
    for keyframe in keyframes[:start]:
        detector.remember(keyframe)
    again = zip(keyframes[start : start + 6], by_descriptor[start:], strict=False)
    for keyframe, before in again:
        for a, b in zip(detector.process(keyframe), before, strict=True):
            assert (a.match_id, a.status, a.reason) == (b.match_id, b.status, b.reason)
            assert np.array_equal(a.T_match_query, b.T_match_query)
            assert np.array_equal(a.covariance, b.covariance)


def test_descriptors_that_do_not_fit_are_made_anew(keyframes):
    detector = LoopDetector(settings())
    other = keyframes[0]
    for descriptor, method in ((None, ''), (np.ones(256, np.float32), 'lcdnet')):
        changed = Keyframe(
            other.id, other.stamp_ns, other.T_odom_base, other.T_previous_this, None, other.cloud,
            descriptor, method,
        )  # fmt: skip
        detector.restore([changed])
    assert detector.size == 1


def test_stages_are_timed_and_memory_is_stated(keyframes):
    stages = []

    @contextmanager
    def timer(stage):
        stages.append(stage)
        yield

    detector = LoopDetector(settings(), timer=timer)
    detector.describe(keyframes[0].cloud)
    for keyframe in keyframes[-20:]:
        detector.process(keyframe)
    detector.restore(keyframes[:10])
    detector.process(keyframes[10])
    assert set(stages) == {'describe', 'retrieve', 'register', 'refine', 'verify'}
    assert 50_000 < detector.bytes_per_keyframe < 210_000


def test_a_pair_can_be_asked_for_by_hand(keyframes, by_descriptor):
    found = next(iter(accepted(by_descriptor).values()))
    loop = LoopDetector(settings()).compare(keyframes[found.match_id], keyframes[found.query_id])
    assert loop.accepted and loop.method == 'pair+bev+gicp'
    assert np.array_equal(loop.T_match_query, found.T_match_query)
