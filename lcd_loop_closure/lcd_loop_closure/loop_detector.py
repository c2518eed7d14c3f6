"""Find loops: describe, retrieve, register, refine, verify."""

from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.bev_registration import BevConfig, BevRegistration, BevView
from lcd_loop_closure.descriptor_index import DescriptorIndex
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.radius_search import GraphPositions, RadiusSearch, RadiusSearchConfig
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.refinement import Refined, Refinement, RefinementConfig, Surface
from lcd_loop_closure.scan_context import ScanContext, ScanContextConfig
from lcd_loop_closure.verification import RangeView, Verdict, Verification, VerificationConfig

Timer = Callable[[str], AbstractContextManager[object]]
Gate = Callable[[Keyframe, Keyframe], str | None]


@config
class LoopDetectorConfig:
    """Which candidates are tried."""

    by_descriptor: bool = setting(True, 'search the descriptors of all keyframes')
    by_radius: bool = setting(True, 'search around the current estimate of the pose graph')
    max_candidates: int = setting(3, 'candidates registered for one keyframe', low=1, high=50)
    max_descriptor_distance: float = setting(
        0.5, 'candidates that look less alike are not registered', low=0.0
    )
    delay: float = setting(
        30.0, 'keyframes met within this distance of travel are no loop candidates', unit='m', low=0
    )
    min_bev_score: float = setting(
        0.2, 'views from above that correlate less are not refined', low=0.0, high=1.0
    )
    cached_clouds: int = setting(16, 'matches kept ready for registration', low=1)


@dataclass(frozen=True)
class LoopDetectorSettings:
    """Settings of the detector and of its stages."""

    detector: LoopDetectorConfig = field(default_factory=LoopDetectorConfig)
    reduction: ReductionConfig = field(default_factory=ReductionConfig)
    descriptor: ScanContextConfig = field(default_factory=ScanContextConfig)
    radius: RadiusSearchConfig = field(default_factory=RadiusSearchConfig)
    registration: BevConfig = field(default_factory=BevConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    verification: VerificationConfig = field(default_factory=VerificationConfig)


@dataclass(frozen=True)
class _Candidate:
    id: int
    found_by: str
    descriptor_distance: float | None = None


@dataclass(frozen=True)
class _Prepared:
    """What registration and verification need of a cloud and that depends on it alone."""

    bev: BevView
    surface: Surface
    range_view: RangeView


class LoopDetector:
    """Remember keyframes and tell which of them a new one returns to.

    Takes clouds in the base frame. Keeps each keyframe's reduced cloud and descriptor; poses belong
    to the pose graph, whose positions come in with `process`. Deterministic: the same keyframes in
    the same order give the same constraints.
    """

    descriptor_method = ScanContext.name

    def __init__(
        self,
        settings: LoopDetectorSettings | None = None,
        *,
        sensor_origin: NDArray[np.float64] | None = None,
        timer: Timer | None = None,
        gate: Gate | None = None,
    ) -> None:
        """Build the stages.

        Args:
            settings: of all stages.
            sensor_origin: [3] position of the LiDAR in the base frame, metres; None: 1.73 m above
                base_link, as on KITTI's car.
            timer: `timer(stage)` is entered around each of the stages describe, retrieve,
                register, refine and verify.
            gate: `gate(query, match)` may veto a candidate before registration by returning the
                reason; None lets it pass (place recognition's uncertainty comes in here).
        """
        self.settings = settings or LoopDetectorSettings()
        s = self.settings
        self._timer = timer or (lambda stage: nullcontext())
        self._gate = gate
        self._descriptor = ScanContext(s.descriptor)
        self._index = DescriptorIndex(self._descriptor, s.detector.delay)
        self._radius = RadiusSearch(s.radius)
        self._registration = BevRegistration(s.registration)
        self._refinement = Refinement(s.refinement)
        self._verification = Verification(s.verification, sensor_origin)
        self.reset()

    def reset(self) -> None:
        """Forget every keyframe."""
        self._keyframes: dict[int, Keyframe] = {}
        self._travelled_m: dict[int, float] = {}
        self._path_m = 0.0
        self._index.clear()
        self._ready: OrderedDict[int, _Prepared] = OrderedDict()

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
            return self._descriptor.describe(cloud.xyz)

    def restore(self, keyframes: Iterable[Keyframe]) -> None:
        """Remember keyframes of a loaded map; all of them are candidates at once.

        Those without a descriptor of this detector's method get one from their reduced cloud.
        """
        for keyframe in keyframes:
            self._remember(keyframe, -np.inf)

    def forget(self, id: int) -> None:
        """Forget one keyframe; an unknown id is no error."""
        self._keyframes.pop(id, None)
        self._travelled_m.pop(id, None)
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
        with self._timer('retrieve'):
            candidates = self._candidates(keyframe, graph)
        loops = self._try(keyframe, candidates)
        self._remember(keyframe, self._path_m)
        return loops

    def remember(self, keyframe: Keyframe) -> None:
        """Take in a keyframe without looking for loops."""
        self._remember(self._arrive(keyframe), self._path_m)

    def compare(self, match: Keyframe, query: Keyframe) -> LoopConstraint:
        """Register and verify one pair of keyframes, whatever retrieval says of them."""
        query = self._described(query)
        return self._evaluate(
            match, query, _Candidate(match.id, 'pair'), self._prepare(query), None
        )

    def _arrive(self, keyframe: Keyframe) -> Keyframe:
        self._path_m += float(np.linalg.norm(keyframe.T_previous_this[:3, 3]))
        return self._described(keyframe)

    def _described(self, keyframe: Keyframe) -> Keyframe:
        method = self.descriptor_method
        if keyframe.descriptor is not None and keyframe.descriptor_method in ('', method):
            return keyframe
        return replace(keyframe, descriptor=self.describe(keyframe.cloud), descriptor_method=method)

    def _remember(self, keyframe: Keyframe, travelled_m: float) -> None:
        keyframe = self._described(keyframe)
        assert keyframe.descriptor is not None
        if keyframe.id in self._keyframes:
            self.forget(keyframe.id)
        self._keyframes[keyframe.id] = keyframe
        self._travelled_m[keyframe.id] = travelled_m
        self._index.add(keyframe.id, keyframe.descriptor, travelled_m)

    def _candidates(self, query: Keyframe, graph: GraphPositions | None) -> list[_Candidate]:
        """Return candidates: radius and descriptor in turn, the radius first, no id twice."""
        s = self.settings.detector
        assert query.descriptor is not None
        looked = []
        if s.by_descriptor:
            looked = self._index.nearest(query.descriptor, self._path_m, s.max_candidates)
        near = []
        if s.by_radius:
            newest = self._path_m - s.delay
            eligible = [i for i, metres in self._travelled_m.items() if metres <= newest]
            near = self._radius.nearest(query, self._keyframes, eligible, graph, s.max_candidates)
        by_descriptor = [_Candidate(m.id, self.descriptor_method, m.distance) for m in looked]
        by_radius = [_Candidate(n.id, 'radius') for n in near]
        merged: dict[int, _Candidate] = {}
        for i in range(s.max_candidates):
            for candidate in (*by_radius[i : i + 1], *by_descriptor[i : i + 1]):
                merged.setdefault(candidate.id, candidate)
        return list(merged.values())[: s.max_candidates]

    def _try(self, query: Keyframe, candidates: list[_Candidate]) -> list[LoopConstraint]:
        limit = self.settings.detector.max_descriptor_distance
        loops: list[LoopConstraint] = []
        prepared: _Prepared | None = None
        spectra = None
        for candidate in candidates:
            match = self._keyframes[candidate.id]
            distance = candidate.descriptor_distance
            if distance is not None and distance > limit:
                reason = f'descriptor distance {distance:.2f} exceeds {limit:g}'
                loops.append(
                    _constraint(match, query, candidate, LoopStatus.REJECTED_DESCRIPTOR, reason)
                )
                continue
            veto = self._gate(query, match) if self._gate else None
            if veto is not None:
                loops.append(
                    _constraint(match, query, candidate, LoopStatus.REJECTED_UNCERTAIN, veto)
                )
                continue
            if prepared is None:
                with self._timer('register'):
                    prepared = self._prepare(query)
                    spectra = self._registration.spectra(prepared.bev)
            loops.append(self._evaluate(match, query, candidate, prepared, spectra))
            if loops[-1].accepted:
                break
        if prepared is not None:
            self._keep_ready(query.id, prepared)
        return loops

    def _evaluate(
        self,
        match: Keyframe,
        query: Keyframe,
        candidate: _Candidate,
        prepared: _Prepared,
        spectra: NDArray[np.complex64] | None,
    ) -> LoopConstraint:
        with self._timer('register'):
            target = self._ready.get(match.id) or self._prepare(match)
            self._keep_ready(match.id, target)
            if spectra is None:
                spectra = self._registration.spectra(prepared.bev)
            hypotheses = self._registration.search(target.bev, spectra, prepared.bev)
        best = hypotheses[0].score if hypotheses else 0.0
        limit = self.settings.detector.min_bev_score
        if not hypotheses or best < limit:
            return _constraint(
                match,
                query,
                candidate,
                LoopStatus.REJECTED_REGISTRATION,
                f'views from above correlate {best:.2f}, below {limit:g}',
            )
        with self._timer('refine'):
            refined = self._refinement.refine(
                target.surface, prepared.surface, hypotheses[0].T_match_query
            )
        with self._timer('verify'):
            verdict = self._verification.check(
                target.surface,
                prepared.surface,
                target.range_view,
                prepared.range_view,
                refined.T_match_query,
                (target.bev.ground_z, prepared.bev.ground_z),
            )
        return _verified(match, query, candidate, refined, verdict)

    def _prepare(self, keyframe: Keyframe) -> _Prepared:
        xyz = keyframe.cloud.xyz
        surface = self._refinement.surface(xyz)
        return _Prepared(
            self._registration.view(xyz), surface, self._verification.range_view(surface)
        )

    def _keep_ready(self, id: int, prepared: _Prepared) -> None:
        self._ready[id] = prepared
        self._ready.move_to_end(id)
        while len(self._ready) > self.settings.detector.cached_clouds:
            self._ready.popitem(last=False)


def _constraint(
    match: Keyframe, query: Keyframe, candidate: _Candidate, status: LoopStatus, reason: str
) -> LoopConstraint:
    return LoopConstraint(
        match_id=match.id,
        query_id=query.id,
        match_stamp_ns=match.stamp_ns,
        query_stamp_ns=query.stamp_ns,
        descriptor_distance=candidate.descriptor_distance,
        method=f'{candidate.found_by}+bev+gicp',
        status=status,
        reason=reason,
    )


def _verified(
    match: Keyframe, query: Keyframe, candidate: _Candidate, refined: Refined, verdict: Verdict
) -> LoopConstraint:
    status, reason = verdict.status, verdict.reason
    if status is LoopStatus.ACCEPTED and refined.covariance is None:
        status = LoopStatus.REJECTED_REGISTRATION
        reason = 'the clouds do not constrain all six degrees of freedom'
    return replace(
        _constraint(match, query, candidate, status, reason),
        T_match_query=refined.T_match_query,
        covariance=refined.covariance,
        fitness=verdict.fitness,
        rmse_m=verdict.rmse_m,
        inliers=verdict.inliers,
        overlap=verdict.overlap,
    )
