"""Find loops: describe, retrieve, register, refine, verify."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_loop_closure.bev_registration import BevConfig
from lcd_loop_closure.descriptor_choice import DescriptorConfig, make_descriptor
from lcd_loop_closure.descriptor_index import DescriptorIndex, PlaceDescriptor
from lcd_loop_closure.feature_registration import FeatureRegistrationConfig
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.local_features import LocalFeatures
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.odometry_reach import OdometryReach
from lcd_loop_closure.pair_registration import (
    PairConfig,
    PairRegistration,
    PairResult,
    PreparedCloud,
    Timer,
)
from lcd_loop_closure.radius_search import GraphPositions, RadiusSearch, RadiusSearchConfig
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.refinement import RefinementConfig
from lcd_loop_closure.scan_context import ScanContextConfig
from lcd_loop_closure.verification import VerificationConfig

Gate = Callable[[Keyframe, Keyframe], str | None]


@config
class LoopDetectorConfig:
    """Which candidates are tried."""

    by_descriptor: bool = setting(True, 'search the descriptors of all keyframes')
    by_radius: bool = setting(True, 'search around the current estimate of the pose graph')
    max_candidates: int = setting(3, 'candidates registered for one keyframe', low=1, high=50)
    delay: float = setting(
        30.0, 'keyframes met within this distance of travel are no loop candidates', unit='m', low=0
    )
    spread: float = setting(
        10.0, 'candidates are at least this far apart along the path', unit='m', low=0.0
    )
    max_drift: float = setting(
        0.3, 'how wrong odometry may be, as a share of the distance driven in between', low=0.0
    )
    trusted_travel: float = setting(
        100.0,
        'candidates too far away by odometry and its max_drift are not tried when less than this '
        'was driven in between, and one for each keyframe otherwise',
        unit='m',
        low=0.0,
    )
    cached_clouds: int = setting(16, 'matches kept ready for registration', low=1)


@dataclass(frozen=True)
class LoopDetectorSettings:
    """Settings of the detector and of its stages."""

    detector: LoopDetectorConfig = field(default_factory=LoopDetectorConfig)
    reduction: ReductionConfig = field(default_factory=ReductionConfig)
    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    lcdnet: LcdnetDescriptorConfig = field(default_factory=LcdnetDescriptorConfig)
    scan_context: ScanContextConfig = field(default_factory=ScanContextConfig)
    radius: RadiusSearchConfig = field(default_factory=RadiusSearchConfig)
    pair: PairConfig = field(default_factory=PairConfig)
    features: FeatureRegistrationConfig = field(default_factory=FeatureRegistrationConfig)
    registration: BevConfig = field(default_factory=BevConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)


@dataclass(frozen=True)
class _Candidate:
    id: int
    found_by: str
    descriptor_distance: float | None = None


class LoopDetector:
    """Remember keyframes and tell which of them a new one returns to.

    Takes clouds in the base frame. Keeps each keyframe's reduced cloud and descriptor; poses belong
    to the pose graph, whose positions come in with `process`. Deterministic: the same keyframes in
    the same order give the same constraints.
    """

    def __init__(
        self,
        settings: LoopDetectorSettings | None = None,
        *,
        descriptor: PlaceDescriptor | None = None,
        sensor_origin: NDArray[np.float64] | None = None,
        timer: Timer | None = None,
        gate: Gate | None = None,
    ) -> None:
        """Build the stages.

        Args:
            settings: of all stages.
            descriptor: what tells places apart; None: made as the settings say.
            sensor_origin: [3] position of the LiDAR in the base frame, metres; None: 1.73 m above
                base_link, as on KITTI's car.
            timer: `timer(stage)` is entered around each of the stages describe, retrieve,
                register, refine and verify.
            gate: `gate(query, match)` may veto a candidate by descriptor before registration by
                returning the reason; None lets it pass (place recognition's uncertainty comes in
                here). Candidates near by the graph do not rest on the look of the place alone.
        """
        self.settings = settings or LoopDetectorSettings()
        s = self.settings
        self._timer = timer or (lambda stage: nullcontext())
        self._gate = gate
        self._descriptor = descriptor or make_descriptor(s.descriptor, s.lcdnet, s.scan_context)
        self.descriptor_method = self._descriptor.name
        self._index = DescriptorIndex(self._descriptor, s.detector.delay)
        self._radius = RadiusSearch(s.radius)
        self._pairs = PairRegistration(
            s.pair,
            s.registration,
            s.refinement,
            s.verification,
            s.features,
            sensor_origin=sensor_origin,
            timer=timer,
        )
        self.reset()

    def reset(self) -> None:
        """Forget every keyframe."""
        self._keyframes: dict[int, Keyframe] = {}
        self._travelled_m: dict[int, float] = {}
        self._restored: set[int] = set()
        self._path_m = 0.0
        self._reach = OdometryReach(
            self.settings.detector.max_drift, self.settings.verification.max_distance
        )
        self._index.clear()
        self._ready: OrderedDict[int, PreparedCloud] = OrderedDict()

    @property
    def size(self) -> int:
        """Number of remembered keyframes."""
        return len(self._keyframes)

    @property
    def bytes_per_keyframe(self) -> float:
        """Mean memory of clouds and descriptors, bytes; 0 when nothing is remembered."""
        total = sum(
            keyframe.cloud.xyz.nbytes
            + (0 if keyframe.cloud.intensity is None else keyframe.cloud.intensity.nbytes)
            + (0 if keyframe.descriptor is None else keyframe.descriptor.nbytes)
            + (0 if keyframe.features is None else keyframe.features.nbytes)
            + 4 * self._descriptor.row_length
            for keyframe in self._keyframes.values()
        )
        return total / max(self.size, 1)

    def reduce(self, cloud: PointCloud) -> PointCloud:
        """Return what a keyframe keeps of a sweep (base frame)."""
        return reduce_cloud(cloud, self.settings.reduction)

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor of a whole sweep (base frame); flattened float32."""
        with self._timer('describe'):
            return self._descriptor.describe(cloud)

    def restore(self, keyframes: Iterable[Keyframe]) -> None:
        """Remember keyframes of a loaded map; all of them are candidates at once.

        Those without a descriptor of this detector's method and size get one from their reduced
        cloud.
        """
        for keyframe in keyframes:
            try:
                self._remember(self._arrive(keyframe), restored=True)
            except DataError:
                continue  # too few points to tell the place: no candidate

    def forget(self, id: int) -> None:
        """Forget one keyframe; an unknown id is no error."""
        self._keyframes.pop(id, None)
        self._travelled_m.pop(id, None)
        self._restored.discard(id)
        self._reach.forget(id)
        self._ready.pop(id, None)
        self._index.remove(id)

    def process(
        self, keyframe: Keyframe, graph: GraphPositions | None = None
    ) -> list[LoopConstraint]:
        """Look for keyframes that this one returns to, then remember it.

        Args:
            keyframe: with its reduced cloud (`reduce`) and descriptor (`describe` of the whole
                sweep); a missing descriptor is made from the reduced cloud.
            graph: the pose graph's positions, as many as are known; None: odometry's.

        Returns:
            Every candidate that was tried, in the order of trial, with its verdict. The search ends
            with the first accepted one.
        """
        keyframe = self._arrive(keyframe)
        self._reach.arrive(keyframe, self._path_m)
        with self._timer('retrieve'):
            candidates = self._candidates(keyframe, graph)
        loops = self._try(keyframe, candidates)
        self._remember(keyframe)
        return loops

    def remember(self, keyframe: Keyframe) -> None:
        """Take in a keyframe without looking for loops."""
        keyframe = self._arrive(keyframe)
        self._reach.arrive(keyframe, self._path_m)
        self._remember(keyframe)

    def compare(self, match: Keyframe, query: Keyframe) -> LoopConstraint:
        """Register and verify one pair of keyframes, whatever retrieval says of them."""
        pair = self._pairs.compare(
            self._pairs.prepare(match.cloud.xyz, self._features(match)),
            self._pairs.prepare(query.cloud.xyz, self._features(query)),
        )
        return _constraint(match, query, _Candidate(match.id, 'pair'), pair)

    def _arrive(self, keyframe: Keyframe) -> Keyframe:
        self._path_m += float(np.linalg.norm(keyframe.T_previous_this[:3, 3]))
        return self._described(keyframe)

    def _described(self, keyframe: Keyframe) -> Keyframe:
        method, descriptor = self.descriptor_method, keyframe.descriptor
        known = descriptor is not None and descriptor.size == self._descriptor.length
        if known and keyframe.descriptor_method in ('', method):
            return keyframe
        return replace(keyframe, descriptor=self.describe(keyframe.cloud), descriptor_method=method)

    def _remember(self, keyframe: Keyframe, restored: bool = False) -> None:
        assert keyframe.descriptor is not None
        if keyframe.id in self._keyframes:
            self.forget(keyframe.id)
            self._reach.arrive(keyframe, self._path_m)
        self._keyframes[keyframe.id] = keyframe
        self._travelled_m[keyframe.id] = self._path_m
        if restored:
            self._restored.add(keyframe.id)
        entered_m = -np.inf if restored else self._path_m
        self._index.add(keyframe.id, keyframe.descriptor, entered_m)

    def _candidates(self, query: Keyframe, graph: GraphPositions | None) -> list[_Candidate]:
        """Return candidates: radius and descriptor in turn, the radius first, no place twice."""
        s = self.settings.detector
        assert query.descriptor is not None
        wanted = 10 * s.max_candidates  # neighbours of each other, most of them
        by_descriptor: list[_Candidate] = []
        by_radius: list[_Candidate] = []
        if s.by_descriptor:
            matches = self._index.nearest(query.descriptor, self._path_m, wanted)
            by_descriptor = [
                _Candidate(match.id, self.descriptor_method, match.distance) for match in matches
            ]
        if s.by_radius:
            newest_m = self._path_m - s.delay
            eligible = [
                id
                for id, travelled_m in self._travelled_m.items()
                if travelled_m <= newest_m or id in self._restored
            ]
            near = self._radius.nearest(query, self._keyframes, eligible, graph, wanted)
            by_radius = [_Candidate(keyframe.id, 'radius') for keyframe in near]
        chosen: list[_Candidate] = []
        unlikely = 0
        for pair in zip_longest(by_radius, by_descriptor):
            for candidate in pair:
                if candidate is None or not self._elsewhere(candidate, chosen):
                    continue
                if not self._reach.plausible(candidate.id, query.id):
                    driven_m = self._path_m - self._travelled_m[candidate.id]
                    if unlikely or driven_m < s.trusted_travel:
                        continue
                    unlikely += 1
                chosen.append(candidate)
        return chosen[: s.max_candidates]

    def _elsewhere(self, candidate: _Candidate, chosen: list[_Candidate]) -> bool:
        at = self._travelled_m[candidate.id]
        spread = self.settings.detector.spread
        return all(
            candidate.id != other.id and abs(at - self._travelled_m[other.id]) >= spread
            for other in chosen
        )

    def _try(self, query: Keyframe, candidates: list[_Candidate]) -> list[LoopConstraint]:
        loops: list[LoopConstraint] = []
        prepared: PreparedCloud | None = None
        for candidate in candidates:
            match = self._keyframes[candidate.id]
            rejection = self._screen(query, match, candidate)
            if rejection is not None:
                loops.append(_constraint(match, query, candidate, rejection))
                continue
            prepared = prepared or self._pairs.prepare(query.cloud.xyz, self._features(query))
            pair = self._pairs.compare(self._prepared(match), prepared)
            loops.append(_constraint(match, query, candidate, pair))
            if pair.status is LoopStatus.ACCEPTED:
                break
        return loops

    def _screen(self, query: Keyframe, match: Keyframe, candidate: _Candidate) -> PairResult | None:
        """Reject a candidate before the expensive stages, or return None."""
        limit = self._descriptor.max_distance
        distance = candidate.descriptor_distance
        if distance is not None and distance > limit:
            reason = f'descriptor distance {distance:.2f} exceeds {limit:g}'
            return PairResult(LoopStatus.REJECTED_DESCRIPTOR, reason)
        veto = self._gate(query, match) if self._gate and distance is not None else None
        return None if veto is None else PairResult(LoopStatus.REJECTED_UNCERTAIN, veto)

    def _features(self, keyframe: Keyframe) -> LocalFeatures | None:
        """Return what registers a keyframe; of a loaded one made from its reduced cloud."""
        if keyframe.features is not None or not len(keyframe.cloud):
            return keyframe.features
        try:
            return self._descriptor.features(keyframe.cloud)
        except DataError:
            return None  # too few points: it is registered without

    def _prepared(self, keyframe: Keyframe) -> PreparedCloud:
        prepared = self._ready.pop(keyframe.id, None) or self._pairs.prepare(
            keyframe.cloud.xyz, self._features(keyframe)
        )
        self._ready[keyframe.id] = prepared
        while len(self._ready) > self.settings.detector.cached_clouds:
            self._ready.popitem(last=False)
        return prepared


def _constraint(
    match: Keyframe, query: Keyframe, candidate: _Candidate, pair: PairResult
) -> LoopConstraint:
    verdict = pair.verdict
    return LoopConstraint(
        match_id=match.id,
        query_id=query.id,
        match_stamp_ns=match.stamp_ns,
        query_stamp_ns=query.stamp_ns,
        T_match_query=pair.T_match_query,
        covariance=pair.covariance,
        descriptor_distance=candidate.descriptor_distance,
        fitness=None if verdict is None else verdict.fitness,
        rmse_m=None if verdict is None else verdict.rmse_m,
        inliers=0 if verdict is None else verdict.inliers,
        overlap=None if verdict is None else verdict.overlap,
        method=f'{candidate.found_by}+{pair.method}',
        status=pair.status,
        reason=pair.reason,
    )
