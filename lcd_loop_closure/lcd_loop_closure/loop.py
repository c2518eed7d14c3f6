"""Hold a candidate loop and what became of it."""

from dataclasses import dataclass
from enum import IntEnum

from lcd_common import se3


class LoopStatus(IntEnum):
    """Verdict on a candidate; the numbers are those of lcd_msgs/LoopConstraint."""

    ACCEPTED = 0
    REJECTED_DESCRIPTOR = 1
    REJECTED_UNCERTAIN = 2
    REJECTED_REGISTRATION = 3
    REJECTED_FITNESS = 4
    REJECTED_OVERLAP = 5
    REJECTED_INCONSISTENT = 6
    REJECTED_BY_GRAPH = 7
    REJECTED_BY_HAND = 8


@dataclass(frozen=True)
class LoopConstraint:
    """A candidate loop between two keyframes; None stands for what was not computed.

    Attributes:
        match_id, match_stamp_ns: keyframe seen earlier.
        query_id, query_stamp_ns: keyframe that returned to it.
        T_match_query: query body in the match's body frame, metres.
        covariance: 6x6 of T_match_query, body axes, translation first.
        descriptor_distance: unit of the descriptor; None when found by a radius search.
        fitness: share of query points with a partner, 0..1.
        rmse_m: of partnered points, metres.
        inliers: partnered points.
        overlap: smaller share of the two directions, 0..1.
        false_match_probability: 0..1, as place recognition says of the query's best match; only of
            candidates by descriptor.
        method: how the candidate was found and registered, e.g. scan_context+bev+gicp.
        status, reason: verdict, and one sentence for people with value and limit.
    """

    match_id: int
    query_id: int
    match_stamp_ns: int
    query_stamp_ns: int
    T_match_query: se3.Array | None = None
    covariance: se3.Array | None = None
    descriptor_distance: float | None = None
    fitness: float | None = None
    rmse_m: float | None = None
    inliers: int = 0
    overlap: float | None = None
    false_match_probability: float | None = None
    method: str = ''
    status: LoopStatus = LoopStatus.ACCEPTED
    reason: str = ''

    @property
    def accepted(self) -> bool:
        """True when the constraint may enter the graph."""
        return self.status is LoopStatus.ACCEPTED
