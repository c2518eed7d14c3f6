"""Make the messages of answers."""

import math

from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from lcd_common import se3
from lcd_common.nodes import messages
from lcd_msgs.msg import PlaceMatch, PlaceMatchArray
from uncertain_place_recognition.place import Match, PlaceAnswer
from uncertain_place_recognition.relocalizer import Relocalized
from uncertain_place_recognition.retrieval.fleet_place import is_elsewhere

_GREEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=0.9)
_RED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.6)
_GREY = ColorRGBA(r=0.6, g=0.6, b=0.6, a=0.6)
_ELSEWHERE, _LOW_BITS = 2**31, 2**31 - 1


def matches_message(answer: PlaceAnswer, header: Header) -> PlaceMatchArray:
    """Make the message of an answer; `header` is the scan's.

    A probability whose guarantee is withdrawn is not calibrated for what the vehicle sees: it is
    NaN, like one that was never calibrated, so that nobody takes it for a verdict.
    """
    return PlaceMatchArray(
        header=header, matches=[_match_message(match, answer) for match in answer.matches]
    )


def message_id(place_id: int) -> int:
    """Return the id of a place in 32 bits; of places in other vehicles' maps from 2^31 upwards.

    Those keep 31 bits of their id: enough to tell the matches of an answer apart, not a fleet's
    places.
    """
    return _ELSEWHERE | (place_id & _LOW_BITS) if is_elsewhere(place_id) else place_id


def _match_message(match: Match, answer: PlaceAnswer) -> PlaceMatch:
    probability = None if answer.withdrawn else match.false_match_probability
    return PlaceMatch(
        place_id=message_id(match.place_id),
        pose=messages.pose_with_covariance(match.T_map_base, match.covariance),
        similarity=match.similarity,
        uncertainty=answer.uncertainty,
        false_match_probability=math.nan if probability is None else probability,
        accepted=match.accepted,
    )


def initial_pose_message(
    found: Relocalized, stamp_ns: int, map_frame: str
) -> PoseWithCovarianceStamped:
    """Make what the pose graph takes as `initialpose`: the pose at the stamp of the scan."""
    return PoseWithCovarianceStamped(
        header=messages.header(stamp_ns, map_frame),
        pose=messages.pose_with_covariance(found.T_map_base, found.covariance),
    )


def answer_markers(
    answer: PlaceAnswer, T_map_base: se3.Array | None, stamp_ns: int, map_frame: str
) -> MarkerArray:
    """Draw the best match: a disc of its resolution, and a line from the vehicle if it is known.

    Green: accepted; red: not; grey: nobody can say, as nothing is calibrated or the guarantee is
    withdrawn.
    """
    header = messages.header(stamp_ns, map_frame)
    best = answer.best
    if best is None:
        return MarkerArray(markers=[Marker(header=header, ns='place', action=Marker.DELETEALL)])
    color = _GREY if answer.withdrawn else _GREEN if best.accepted else _RED
    disc = Marker(header=header, ns='place', type=Marker.CYLINDER, action=Marker.ADD, color=color)
    disc.pose = messages.pose_message(best.T_map_base)
    disc.scale.x = disc.scale.y = 2.0 * float(best.covariance[0, 0]) ** 0.5
    disc.scale.z = 0.2
    text = Marker(header=header, ns='place text', type=Marker.TEXT_VIEW_FACING, color=color)
    text.pose = messages.pose_message(best.T_map_base)
    text.pose.position.z += 4.0
    text.scale.z = 2.0
    text.text = _caption(best, answer)
    line = Marker(header=header, ns='place line', type=Marker.LINE_LIST, color=color)
    line.pose.orientation.w, line.scale.x = 1.0, 0.3
    # An empty line list is an error in RViz: delete it instead.
    line.action = Marker.DELETE if T_map_base is None else Marker.ADD
    if T_map_base is not None:
        line.points = [
            Point(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
            for T in (T_map_base, best.T_map_base)
        ]
    return MarkerArray(markers=[disc, text, line])


def _caption(best: Match, answer: PlaceAnswer) -> str:
    if answer.withdrawn or best.false_match_probability is None:
        return f'place {message_id(best.place_id)}, u {answer.uncertainty_normalised:.3f}'
    return f'place {message_id(best.place_id)}, {best.false_match_probability:.1%} wrong'
