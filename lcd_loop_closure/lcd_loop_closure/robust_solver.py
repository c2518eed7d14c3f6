"""Find the false loops of a whole graph, and odometry links that broke without saying so.

Every loop is either right, and costs its squared residual, or wrong, and costs a constant:
truncated least squares with odometry as known inliers. Its minimum is found from a solve with a
Cauchy kernel by graduated non-convexity. What that loses in local minima is regained by moves that
must lower the same cost: take in a group of loops that agree with each other, or give up one
odometry link that many loops contradict.

GTSAM's bindings hold Python's interpreter lock while they solve, for up to a second on ten thousand
keyframes: run the solver in a process of its own where callbacks must not wait. Snapshots and
verdicts are plain arrays and travel as npz files, without pickle (`verdict_process`).
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure import broken_links
from lcd_loop_closure import pairwise_consistency as pairs
from lcd_loop_closure.graph_snapshot import GraphSnapshot, LoopKey, LoopState
from lcd_loop_closure.truncated_least_squares import Minimum, TruncatedLeastSquares
from lcd_loop_closure.weighted_graph import WeightedGraph, Weights

# When covariances count as far too large (squared), and how far the limit may follow them.
_LARGEST_SCALE = 0.5
_SMALLEST_SCALE = 1e-6
_RESCALINGS = 5
_FEWEST_TO_RESCALE = 30


@config
class RobustSolverConfig:
    """How the solver tells false loops from true ones."""

    inlier_probability: float = setting(
        0.999, 'share of true loops that pass the residual test', low=0.5, high=0.999999
    )
    cauchy_scale: float = setting(1.0, 'width of the first kernel, in sigmas', low=0.1)
    gnc_start: float = setting(0.02, 'first mu of graduated non-convexity', low=1e-6)
    gnc_factor: float = setting(2.0, 'growth of mu from stage to stage', low=1.05)
    group_reach: int = setting(40, 'loops are compared within so many keyframes', low=1)
    group_trials: int = setting(5, 'agreeing groups that are tried in one solve', low=0)
    broken_link_trials: int = setting(
        3, 'links that may be found broken in one solve (0: trust odometry)', low=0
    )
    broken_link_loops: int = setting(10, 'loops that giving up a link must make right', low=2)
    broken_link_span: float = setting(
        40.0, 'way along which these loops must begin, and end', unit='m', low=0.0
    )
    broken_link_jump: float = setting(
        5.0, 'farthest translation by which a link may have been wrong', unit='m', low=0.0
    )
    broken_link_cost: float = setting(
        100.0, 'what giving up a link costs, as a squared distance', low=0.0
    )
    weak_translation: float = setting(
        1.0, 'a link with more translation noise is placed by loops first', unit='m', low=0.0
    )
    weak_rotation: float = setting(
        0.2, 'a link with more rotation noise is placed by loops first', unit='rad', low=0.0
    )


@dataclass(frozen=True)
class Verdict:
    """What the solver found out about the loops of a snapshot.

    Attributes:
        accepted: loops that belong to the graph.
        rejected: loops that do not, each with one sentence for people.
        broken_links: ids of keyframes whose link to their predecessor is wrong.
        arrivals: the snapshot's; loops that came later are not judged.
        ids, T_map_base: the solved poses [N x 4 x 4] of the snapshot's keyframes.
        iterations: linear solves.
        seconds: wall time.
    """

    accepted: frozenset[LoopKey]
    rejected: dict[LoopKey, str]
    broken_links: tuple[int, ...]
    arrivals: int
    ids: NDArray[np.int64]
    T_map_base: se3.Array
    iterations: int
    seconds: float

    @property
    def judged_ids(self) -> frozenset[int]:
        """Ids of the keyframes that the snapshot had."""
        return frozenset(self.ids.tolist())


class RobustSolver:
    """Judge all loops of a snapshot together; runs beside the filter, shares nothing with it."""

    def __init__(self, settings: RobustSolverConfig) -> None:
        self.settings = settings

    def solve(self, snapshot: GraphSnapshot) -> Verdict:
        """Return which loops are right, starting from the snapshot's own estimate."""
        started = time.perf_counter()
        used = tuple(loop for loop in snapshot.loops if loop.state is not LoopState.UNUSED)
        judgement = _Judgement(self.settings, replace(snapshot, loops=used))
        minimum = judgement.run()
        residuals = judgement.graph.residuals()
        limit = np.sqrt(judgement.problem.threshold)
        rejected = {
            loop.key: f'contradicts odometry and the other loops by {np.sqrt(r):.1f} sigma '
            f'(limit {limit:.1f})'
            for loop, w, r in zip(used, minimum.weights, residuals, strict=True)
            if w == 0
        }
        return Verdict(
            frozenset(loop.key for loop in used if loop.key not in rejected),
            rejected,
            tuple(int(snapshot.ids[row]) for row in judgement.graph.loose_rows),
            snapshot.arrivals,
            snapshot.ids,
            minimum.poses,
            judgement.graph.iterations,
            time.perf_counter() - started,
        )


class _Judgement:
    """One snapshot on its way to a verdict."""

    def __init__(self, settings: RobustSolverConfig, snapshot: GraphSnapshot) -> None:
        self.settings = settings
        self.snapshot = snapshot
        self.graph = WeightedGraph(snapshot)
        self.fixed = np.array([loop.state is LoopState.BY_HAND for loop in snapshot.loops], bool)
        self.nominal_threshold = float(chi2.ppf(settings.inlier_probability, 6))
        self.scale = 1.0
        self.problem = TruncatedLeastSquares(self.graph, self.nominal_threshold, self.fixed)
        self.loops = pairs.LoopMeasurements(
            self.graph.ends,
            np.array([loop.T_match_query for loop in snapshot.loops]).reshape(-1, 4, 4),
            np.array([loop.covariance for loop in snapshot.loops]).reshape(-1, 6, 6),
        )

    def run(self) -> Minimum:
        """Bridge, minimise, then improve by moves; the graph ends at the returned minimum."""
        if not len(self.fixed):
            # Odometry alone has no residual: the estimate is already its minimum.
            if not self.snapshot.gnss:
                return Minimum(self.snapshot.T_map_base, np.zeros(0), 0.0)
            return self.problem.settle()
        start = self._bridged(self.snapshot.T_map_base)
        minimum = self._rescaled(self._minimise(start), start)
        minimum = self._take_in_groups(minimum)
        for _ in range(self.settings.broken_link_trials):
            better = self._give_up_link(minimum)
            if better is None:
                break
            minimum = better
        minimum = self._believe_again(minimum)
        self.graph.poses = minimum.poses
        return minimum

    def _rescaled(self, minimum: Minimum, start: se3.Array) -> Minimum:
        """Solve again with a lower limit where the covariances turn out to be far too large.

        What the accepted factors cost, over their degrees of freedom, is the variance factor of an
        adjustment; it is one for honest covariances. A graph whose file says 1 m and 0.5 rad for
        every link (parking-garage) lets a wrong loop fold it for less than a limit in such units.
        """
        for _ in range(_RESCALINGS):
            right = minimum.weights > 0
            if right.sum() < _FEWEST_TO_RESCALE:
                break
            wrong_cost = self.problem.threshold * float((~right).sum())
            factor = (minimum.cost - wrong_cost) / (6.0 * float(right.sum()))
            # Twice the sigma, so that heavier tails than Gauss's still pass.
            scale = max(4.0 * factor, _SMALLEST_SCALE)
            if scale > _LARGEST_SCALE or scale > 0.7 * self.scale:
                break
            self.scale = scale
            self.problem.threshold = scale * self.nominal_threshold
            # What the too high limit let in may have folded the graph for good: also start afresh.
            trials = [self._minimise(poses) for poses in (minimum.poses, start)]
            minimum = min(trials, key=lambda trial: trial.cost)
        return minimum

    def _minimise(self, start: se3.Array) -> Minimum:
        s = self.settings
        cauchy_scale = s.cauchy_scale * float(np.sqrt(self.scale))
        return self.problem.minimise(start, cauchy_scale, s.gnc_start, s.gnc_factor)

    def _chain(self, poses: se3.Array) -> pairs.ChainCovariance:
        return pairs.ChainCovariance(poses, self.snapshot.motion_covariances)

    def _subset(self, indices: NDArray[np.int64]) -> pairs.LoopMeasurements:
        loops = self.loops
        return pairs.LoopMeasurements(
            loops.ends[indices], loops.T_match_query[indices], loops.covariances[indices]
        )

    def _groups(self, poses: se3.Array, indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return groups of the given loops that agree with each other, largest first."""
        groups = pairs.agreeing_groups(
            self._chain(poses),
            self._subset(indices),
            self.problem.threshold,
            self.settings.group_reach,
        )
        return [indices[group] for group in groups]

    def _bridged(self, poses: se3.Array) -> se3.Array:
        """Place what follows a link that says next to nothing where the loops across it have it.

        Gauss-Newton does not find the way from half a turn off.
        """
        self.graph.poses = poses
        residuals = self.graph.residuals()
        for row in self._weak_rows():
            ends = self.loops.ends
            across = np.nonzero((ends.min(axis=1) < row) & (ends.max(axis=1) >= row))[0]
            if not len(across) or np.any(residuals[across] <= self.problem.threshold):
                continue
            groups = self._groups(poses, across)
            if not groups and len(across) > 1:
                continue
            loops = self._subset(groups[0] if groups else across)
            links = broken_links.implied_links(poses, loops, row)
            middle = np.median(links[:, :3, 3], axis=0)
            nearest = int(np.argmin(np.linalg.norm(links[:, :3, 3] - middle, axis=1)))
            poses = broken_links.moved(poses, row, links[nearest])
            self.graph.poses = poses
            residuals = self.graph.residuals()
        return poses

    def _weak_rows(self) -> list[int]:
        """Return the rows whose link is far less sure than the others, or was given up."""
        sigmas = np.sqrt(np.diagonal(self.snapshot.motion_covariances, axis1=1, axis2=2))
        move, turn = sigmas[:, :3].max(axis=1), sigmas[:, 3:].max(axis=1)
        weak = (move > np.maximum(self.settings.weak_translation, 10.0 * np.median(move))) | (
            turn > np.maximum(self.settings.weak_rotation, 10.0 * np.median(turn))
        )
        weak[self.graph.loose_rows] = True
        weak[0] = False
        return [int(row) for row in np.nonzero(weak)[0]]

    def _take_in_groups(self, minimum: Minimum) -> Minimum:
        """Try each rejected group, and each rejected loop alone, that could lower the cost."""
        out = np.nonzero(minimum.weights == 0)[0]
        if not len(out):
            return minimum
        groups = self._groups(minimum.poses, out)
        alone = np.setdiff1d(out, np.concatenate(groups) if groups else [])
        candidates = groups + [np.array([k]) for k in alone]
        candidates = self._worth_trying(minimum, candidates)
        for group in candidates[: self.settings.group_trials]:
            weights = minimum.weights.copy()
            weights[group] = 1.0
            trial = self.problem.settle(weights, minimum.poses)
            if trial.cost < minimum.cost - 1e-3:
                minimum = trial
        return minimum

    def _worth_trying(
        self, minimum: Minimum, candidates: list[NDArray[np.int64]]
    ) -> list[NDArray[np.int64]]:
        """Drop the groups of which a single loop would already cost more than all of it could save.

        Odometry's chain is less sure than the graph, so what contradicts even it need not be looked
        at more closely.
        """

        def saving(distance: Weights) -> list[NDArray[np.int64]]:
            limit = self.problem.threshold
            return [g for g in candidates if distance[g].max() <= len(g) * limit]

        self.graph.poses = minimum.poses
        distance = pairs.odometry_distances(self._chain(minimum.poses), self.loops)
        candidates = saving(distance)
        candidates.sort(key=lambda g: (distance[g].max() / len(g), int(g[0])))
        candidates = candidates[: 2 * self.settings.group_trials]
        if candidates:
            looked_at = np.array([group[0] for group in candidates])
            distance[looked_at] = self.graph.distances(minimum.weights, looked_at)
        return saving(distance)

    def _give_up_link(self, minimum: Minimum) -> Minimum | None:
        """Return a better minimum without one odometry link, or None when there is none."""
        s = self.settings
        out = np.nonzero(minimum.weights == 0)[0]
        groups = [g for g in self._groups(minimum.poses, out) if len(g) > 2]
        if not groups:
            return None
        suspect = broken_links.suspect_link(
            minimum.poses,
            self.snapshot.motions,
            self._subset(np.sort(np.concatenate(groups))),
            self.loops.ends[minimum.weights > 0],
            s.broken_link_loops,
            s.broken_link_jump,
        )
        if suspect is None or suspect.row in self.graph.loose_rows:
            return None
        self.graph.loosen(suspect.row)
        trial = self._minimise(
            broken_links.moved(minimum.poses, suspect.row, suspect.T_previous_this)
        )
        gained = self.loops.ends[(trial.weights > 0) & (minimum.weights == 0)]
        lost = int(((trial.weights == 0) & (minimum.weights > 0)).sum())
        if (
            trial.cost + s.broken_link_cost < minimum.cost
            and len(gained) >= s.broken_link_loops
            and lost <= 0.1 * len(gained)
            and self._span_m(gained) >= s.broken_link_span
        ):
            return trial
        self.graph.tighten(suspect.row)
        return None

    def _span_m(self, ends: NDArray[np.int64]) -> float:
        """Return the way from the first to the last match or query, whichever is shorter."""
        steps = np.linalg.norm(self.snapshot.motions[:, :3, 3], axis=1)
        along = np.cumsum(steps)
        return float(min(np.ptp(along[ends[:, side]]) for side in (0, 1)))

    def _believe_again(self, minimum: Minimum) -> Minimum:
        """Tighten links where that costs less than giving them up."""
        for row in self.graph.loose_rows:
            self.graph.tighten(row)
            trial = self.problem.settle(minimum.weights, minimum.poses)
            if trial.cost < minimum.cost + self.settings.broken_link_cost:
                minimum = trial
            else:
                self.graph.loosen(row)
        return minimum
