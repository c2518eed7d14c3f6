"""Draw loops for RViz and Foxglove."""

from collections.abc import Iterable, Mapping

from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from lcd_common import se3
from lcd_common.nodes.messages import header
from lcd_loop_closure.loop import LoopConstraint

_GREEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=1.0)
_RED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.6)


def loop_markers(
    loops: Iterable[LoopConstraint],
    xyz_map: Mapping[int, se3.Array],
    stamp_ns: int,
    frame_id: str,
) -> MarkerArray:
    """Make two line lists, `accepted` in green and `rejected` in red.

    Args:
        loops: each is a line between its keyframes; one whose keyframe has no position is left out.
        xyz_map: position [3] of every keyframe by id, metres.
        stamp_ns: of the markers.
        frame_id: of the positions.
    """
    lines: dict[bool, list[Point]] = {True: [], False: []}
    for loop in loops:
        ends = xyz_map.get(loop.match_id), xyz_map.get(loop.query_id)
        if ends[0] is not None and ends[1] is not None:
            lines[loop.accepted] += [
                Point(x=float(p[0]), y=float(p[1]), z=float(p[2])) for p in ends if p is not None
            ]
    return MarkerArray(
        markers=[
            _line_list('accepted', lines[True], _GREEN, 0.4, stamp_ns, frame_id),
            _line_list('rejected', lines[False], _RED, 0.15, stamp_ns, frame_id),
        ]
    )


def _line_list(
    name: str, points: list[Point], color: ColorRGBA, width_m: float, stamp_ns: int, frame_id: str
) -> Marker:
    marker = Marker(
        header=header(stamp_ns, frame_id),
        ns=name,
        type=Marker.LINE_LIST,
        # An empty line list is an error in RViz: delete it instead.
        action=Marker.ADD if points else Marker.DELETE,
        color=color,
        points=points,
    )
    marker.scale.x = width_m
    marker.pose.orientation.w = 1.0
    return marker
