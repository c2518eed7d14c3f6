"""Run the loop detector on a thread of its own, session after session."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.descriptor_choice import make_descriptor
from lcd_loop_closure.keyframe_builder import KeyframeBuilder
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.loop_detector import LoopDetector, LoopDetectorSettings
from lcd_loop_closure.pair_registration import Timer
from lcd_loop_closure.place_gate import PlaceVerdict
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.reduction import reduce_cloud


class Session:
    """From one start, reset, clock jump or loaded map to the next; told apart by identity."""

    def __init__(self, loaded: tuple[Keyframe, ...] = ()) -> None:
        """Start a session; `loaded` are the keyframes of a map that it continues."""
        self.loaded = loaded
        self.first_id = loaded[-1].id + 1 if loaded else 0
        self.builder = KeyframeBuilder(self.first_id)


@dataclass(frozen=True)
class SearchJob:
    """A keyframe to look for, and what is known at that time.

    Attributes:
        session: that the keyframe belongs to.
        keyframe: with its reduced cloud and descriptor.
        sensor_origin: [3] position of the LiDAR in the base frame, metres.
        graph: the pose graph's positions; None before there are any.
        search: False only remembers the keyframe.
        verdict: what place recognition says of its scan, which is for its candidates by descriptor;
            None when it was not asked or did not answer.
    """

    session: Session
    keyframe: Keyframe
    sensor_origin: NDArray[np.float64]
    graph: GraphPositions | None
    search: bool = True
    verdict: PlaceVerdict | None = None


class LoopSearch:
    """Own the detector, so that only one thread ever touches it.

    The detector is built with the first keyframe of a session: before it nobody knows where the
    sensor sits.
    """

    def __init__(self, settings: LoopDetectorSettings, timer: Timer) -> None:
        self._settings, self._timer = settings, timer
        self._descriptor = make_descriptor(
            settings.descriptor, settings.lcdnet, settings.scan_context
        )
        self._session: Session | None = None
        self._detector: LoopDetector | None = None
        self._veto: str | None = None

    @property
    def size(self) -> int:
        """Number of remembered keyframes."""
        return 0 if self._detector is None else self._detector.size

    @property
    def device(self) -> str | None:
        """Where the network of the descriptor runs; None when it has none."""
        device = getattr(self._descriptor, 'device', None)
        return None if device is None else str(device)

    def keyframe(self, session: Session, pose: StampedPose, cloud: PointCloud) -> Keyframe | None:
        """Reduce and describe a sweep (base frame) and make it the session's next keyframe.

        None when no point is left. May be called on another thread than `run`.

        Raises:
            DataError: too few points are left to tell the place.
        """
        with self._timer('reduce'):
            reduced = reduce_cloud(cloud, self._settings.reduction)
        if not len(reduced):
            return None
        with self._timer('describe'):
            descriptor = self._descriptor.describe(cloud)
            features = self._descriptor.features(cloud)
        name = self._descriptor.name
        return session.builder.build(pose, reduced, descriptor, name, features)

    def run(self, job: SearchJob) -> list[LoopConstraint]:
        """Return every candidate that was tried for the keyframe, with its verdict."""
        if self._detector is None or job.session is not self._session:
            self._session = job.session
            self._detector = LoopDetector(
                self._settings,
                descriptor=self._descriptor,
                sensor_origin=job.sensor_origin,
                timer=self._timer,
                gate=lambda query, match: self._veto,
            )
            self._detector.restore(job.session.loaded)
        if not job.search:
            self._detector.remember(job.keyframe)
            return []
        self._veto = None if job.verdict is None else job.verdict.rejected
        loops = self._detector.process(job.keyframe, _usable(job))
        return [_judged(loop, job.verdict) for loop in loops]


def _judged(loop: LoopConstraint, verdict: PlaceVerdict | None) -> LoopConstraint:
    """Say how likely the look of the place misleads, of a candidate that was found by it."""
    if verdict is None or loop.descriptor_distance is None:
        return loop
    return replace(loop, false_match_probability=verdict.false_match_probability)


def _usable(job: SearchJob) -> GraphPositions | None:
    """Leave out the positions while the graph does not know where the session lies in its map.

    The loaded keyframes have map positions and the new ones odometry's: near by number is not near.
    """
    first = job.session.first_id
    if first == 0:
        return job.graph
    located = job.graph is not None and len(job.graph.ids) and job.graph.ids[-1] >= first
    return job.graph if located else _NOWHERE


_NOWHERE = GraphPositions(np.empty(0, np.int64), np.empty((0, 3)))
