"""Find out how two keyframes lie to each other, and whether they show the same place at all."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.bev_registration import BevConfig, BevRegistration, BevView
from lcd_loop_closure.feature_registration import (
    FeatureRegistration,
    FeatureRegistrationConfig,
)
from lcd_loop_closure.local_features import LocalFeatures
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.refinement import Refinement, RefinementConfig, Surface
from lcd_loop_closure.verification import RangeView, Verdict, Verification, VerificationConfig

Timer = Callable[[str], AbstractContextManager[object]]


@config
class PairConfig:
    """Early exits: what they stop would not pass verification, but would cost its time."""

    min_bev_score: float = setting(
        0.18, 'views from above that correlate less are not refined', low=0.0, high=1.0
    )
    min_rough_fitness: float = setting(
        0.2, 'roughly aligned clouds that fit less are not refined', low=0.0, high=1.0
    )
    distinct_score: float = setting(
        0.75, 'answers of the global search below this share of the best are no rivals', low=0.0
    )
    max_ambiguity: float = setting(
        0.6, 'fitness of the best other pose, as a share of the best one', low=0.0, high=1.0
    )


class PreparedCloud:
    """What the stages need of one cloud and that depends on it alone, made when first asked for."""

    def __init__(
        self,
        xyz: NDArray[np.float32],
        stages: 'PairRegistration',
        features: LocalFeatures | None = None,
    ) -> None:
        self._xyz, self._stages, self.features = xyz, stages, features

    @cached_property
    def bev(self) -> BevView:
        """View from above."""
        return self._stages.registration.view(self._xyz)

    @cached_property
    def spectra(self) -> NDArray[np.complex64]:
        """Spectra of the view from above, turned (6 MB, of the query alone)."""
        return self._stages.registration.spectra(self.bev)

    @cached_property
    def surface(self) -> Surface:
        """Points with their covariances."""
        return self._stages.refinement.surface(self._xyz)

    @cached_property
    def range_view(self) -> RangeView:
        """How far the sensor saw."""
        return self._stages.verification.range_view(self._xyz)


@dataclass(frozen=True)
class PairResult:
    """Relative pose of two clouds and the verdict on it; None stands for what was not reached.

    Attributes:
        status, reason: ACCEPTED or why not, one sentence with value and limit.
        T_match_query: pose of the query in the match, metres.
        covariance: 6x6, body axes, translation first; only of accepted pairs.
        verdict: measures of the verification.
        method: what registered them, as in 'lcdnet+gicp'.
    """

    status: LoopStatus
    reason: str
    T_match_query: se3.Array | None = None
    covariance: se3.Array | None = None
    verdict: Verdict | None = None
    method: str = 'bev+gicp'


class PairRegistration:
    """Register, refine by GICP, verify; every stage may end it with a reason.

    Clouds with features are registered by these; where their answers do not fit, and for clouds
    without, the views from above are searched.
    """

    def __init__(
        self,
        settings: PairConfig | None = None,
        registration: BevConfig | None = None,
        refinement: RefinementConfig | None = None,
        verification: VerificationConfig | None = None,
        features: FeatureRegistrationConfig | None = None,
        *,
        sensor_origin: NDArray[np.float64] | None = None,
        timer: Timer | None = None,
    ) -> None:
        """Build the stages; `timer(stage)` is entered around register, refine and verify."""
        self.settings = settings or PairConfig()
        self.registration = BevRegistration(registration)
        self.by_features = FeatureRegistration(features)
        self.refinement = Refinement(refinement)
        self.verification = Verification(verification, sensor_origin)
        self._timer = timer or (lambda stage: nullcontext())

    def prepare(
        self, xyz: NDArray[np.float32], features: LocalFeatures | None = None
    ) -> PreparedCloud:
        """Prepare a reduced cloud [N x 3], base frame; nothing is computed before it is needed."""
        return PreparedCloud(xyz, self, features)

    def compare(self, match: PreparedCloud, query: PreparedCloud) -> PairResult:
        """Find the query's pose in the match and judge it; no initial guess is needed."""
        if match.features is not None and query.features is not None:
            result = self._compare_features(match, query, match.features, query.features)
            if result is not None:
                return result
        return self._compare_views(match, query)

    def _compare_features(
        self,
        match: PreparedCloud,
        query: PreparedCloud,
        of_match: LocalFeatures,
        of_query: LocalFeatures,
    ) -> PairResult | None:
        """Judge the answers of the features; None when the best does not fit the clouds."""
        with self._timer('register'):
            found = self.by_features.register(of_query, of_match)
        if not found:
            return None
        with self._timer('refine'):
            fitness, rival, T_match_query = self._best(
                match, query, [answer.T_match_query for answer in found]
            )
        if fitness < self.verification.settings.min_fitness:
            return None
        return self._judge(match, query, fitness, rival, T_match_query, 'lcdnet+gicp')

    def _compare_views(self, match: PreparedCloud, query: PreparedCloud) -> PairResult:
        s = self.settings
        rejected = LoopStatus.REJECTED_REGISTRATION
        with self._timer('register'):
            hypotheses = self.registration.search(match.bev, query.spectra, query.bev)
        if not hypotheses:
            return PairResult(rejected, 'nothing stands on the ground in one of the clouds')
        score = hypotheses[0].score
        if score < s.min_bev_score:
            reason = f'views from above correlate {score:.2f}, below {s.min_bev_score:g}'
            return PairResult(rejected, reason)
        with self._timer('refine'):
            likely = s.distinct_score * score
            fitness, rival, T_match_query = self._best(
                match,
                query,
                [answer.T_match_query for answer in hypotheses if answer.score >= likely],
                [answer.T_match_query for answer in hypotheses if answer.score < likely],
            )
        if fitness < s.min_rough_fitness:
            reason = f'roughly aligned, fitness {fitness:.2f} is below {s.min_rough_fitness:g}'
            return PairResult(LoopStatus.REJECTED_FITNESS, reason, T_match_query)
        return self._judge(match, query, fitness, rival, T_match_query, 'bev+gicp')

    def _judge(
        self,
        match: PreparedCloud,
        query: PreparedCloud,
        fitness: float,
        rival: float,
        T_match_query: se3.Array,
        method: str,
    ) -> PairResult:
        """Refine the best answer and verify it."""
        s, rejected = self.settings, LoopStatus.REJECTED_REGISTRATION
        with self._timer('refine'):
            if rival > s.max_ambiguity * fitness:
                reason = (
                    f'another pose fits nearly as well, {rival:.2f} against {fitness:.2f}: '
                    f'at most {s.max_ambiguity:g} of it is allowed'
                )
                return PairResult(rejected, reason, T_match_query, method=method)
            refined = self.refinement.refine(match.surface, query.surface, T_match_query)
        T_match_query = refined.T_match_query
        with self._timer('verify'):
            verdict = self.verification.check(
                match.surface,
                query.surface,
                match.range_view,
                query.range_view,
                T_match_query,
                (match.bev.ground_z, query.bev.ground_z),
            )
            if verdict.status is not LoopStatus.ACCEPTED:
                return PairResult(
                    verdict.status, verdict.reason, T_match_query, None, verdict, method
                )
            covariance = self.refinement.covariance(match.surface, query.surface, T_match_query)
        if covariance is None:
            reason = 'the clouds do not constrain all six degrees of freedom'
            return PairResult(rejected, reason, T_match_query, None, verdict, method)
        return PairResult(
            verdict.status, verdict.reason, T_match_query, covariance, verdict, method
        )

    def _best(
        self,
        match: PreparedCloud,
        query: PreparedCloud,
        likely: list[se3.Array],
        unlikely: Sequence[se3.Array] = (),
    ) -> tuple[float, float, se3.Array]:
        """Return fitness of the best answer, of the best that ends elsewhere, and the pose.

        The unlikely ones are tried only while the first likely one does not fit.
        """
        tried: list[tuple[float, se3.Array]] = []
        for number, guess in enumerate([*likely, *unlikely]):
            if number >= len(likely) and tried[0][0] >= self.verification.settings.min_fitness:
                break
            T = self.refinement.approach(match.surface, query.surface, guess)
            fitness = self.verification.fitness(match.surface, query.surface, T, query.bev.ground_z)
            tried.append((fitness, T))
        best, T_match_query = max(tried, key=lambda result: result[0])
        rivals = [fitness for fitness, T in tried if _differ(T_match_query, T)]
        return best, max(rivals, default=0.0), T_match_query


def _differ(T_a_b: se3.Array, T_a_c: se3.Array) -> bool:
    """Tell whether two roughly refined poses are two answers, not one reached twice."""
    metres, radians = se3.distance(T_a_b, T_a_c)
    return metres > 2.0 or radians > 0.25
