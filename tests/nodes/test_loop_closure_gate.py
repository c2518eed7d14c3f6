"""Let place recognition decide which candidates loop_closure registers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from fed_loop_closure import Fed

from lcd_common.nodes import messages
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_msgs.msg import LoopConstraint, PlaceMatch, PlaceMatchArray

pytestmark = pytest.mark.ros
Make = Callable[..., Any]


def _place_matches(step: int, probability: float, accepted: bool) -> PlaceMatchArray:
    match = PlaceMatch(place_id=7, false_match_probability=probability, accepted=accepted)
    return PlaceMatchArray(header=messages.header(drive.stamp(step), 'lidar'), matches=[match])


def test_the_gate_holds_a_keyframe_until_place_recognition_answered(
    make_often: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed = Fed(
        make_often(
            LoopClosureNode, threaded=False, gate__use=True, gate__wait=0.5, gate__window=0.1
        )
    )
    jobs: list[Any] = []

    def note(job: Any) -> list[Any]:
        said = (job.verdict.rejected, job.verdict.false_match_probability) if job.verdict else None
        jobs.append((job.keyframe.id, said))
        return []

    monkeypatch.setattr(fed.node._search, 'run', note)
    fed.step(0)
    assert len(fed.keyframes) == 1 and jobs == []  # published at once, searched later
    fed.lockstep.feed('/place_matches', _place_matches(0, 0.4, False))
    why = 'place recognition does not accept its best match, place 7: 40% likely to be wrong'
    assert jobs == [(0, (why, pytest.approx(0.4)))]
    fed.lockstep.feed('/place_matches', _place_matches(3, 0.01, True))  # sooner than the keyframe
    fed.step(3)
    fed.lockstep.feed('/place_matches', _place_matches(6, float('nan'), False))  # not calibrated
    fed.step(6)
    fed.lockstep.feed('/place_matches', PlaceMatchArray(header=drive.scan(9).header))  # no map yet
    fed.step(9)
    assert jobs[1:] == [(1, (None, pytest.approx(0.01))), (2, (None, None)), (3, (None, None))]
    for step in range(12, 18):  # place recognition is gone: after half a second it goes on
        fed.step(step)
    assert [job[0] for job in jobs] == [0, 1, 2, 3]
    fed.step(18)
    assert jobs[4:] == [(4, None)]
    assert fed.counted('keyframes rejected by place recognition') == 1
    assert fed.counted('keyframes searched without an answer of place recognition') == 1


@pytest.mark.parametrize('by', ['descriptor', 'radius'])
def test_candidates_by_descriptor_tell_the_probability_of_the_gate(
    make_often: Make, by: str
) -> None:
    node = make_often(
        LoopClosureNode,
        threaded=False,
        gate__use=True,
        detector__delay=10.0,
        detector__by_descriptor=by == 'descriptor',
        detector__by_radius=by == 'radius',
        descriptor__method='scan_context',
    )
    fed = Fed(node)
    around, nan = 126, float('nan')  # steps of a round, of which every third is a keyframe
    answers = {126: (0.4, False), 129: (0.03, True), 132: (nan, False)}
    for step in [*range(0, around, 3), *answers]:
        fed.lockstep.feed('/place_matches', _place_matches(step, *answers.get(step, (0.9, True))))
        fed.lockstep.feed('/points', drive.scan(step % around, stamp_ns=drive.stamp(step)))
        fed.lockstep.feed('/odom', drive.odom_message(step))
    said = {
        id: {(m.status, round(m.false_match_probability, 3)) for m in fed.loops if m.query_id == id}
        for id in (42, 43)
    }
    of_44 = [m for m in fed.loops if m.query_id == 44]
    assert of_44 and all(np.isnan(m.false_match_probability) for m in of_44)  # not calibrated
    assert of_44[-1].status == of_44[-1].ACCEPTED
    if by == 'descriptor':
        assert (LoopConstraint.REJECTED_UNCERTAIN, 0.4) in said[42]
        assert {probability for _, probability in said[42]} == {0.4}  # not alike enough: too
        assert (LoopConstraint.ACCEPTED, 0.03) in said[43]
    else:  # they do not rest on the look of the place
        assert fed.loops and all(np.isnan(m.false_match_probability) for m in fed.loops)


def test_without_the_gate_place_recognition_is_not_heard(make_often: Make) -> None:
    node = make_often(LoopClosureNode, threaded=False)
    assert '/place_matches' not in {s.topic_name for s in node.subscriptions}
