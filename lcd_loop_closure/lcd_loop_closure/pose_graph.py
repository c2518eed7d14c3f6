"""Keep the corrected poses of all keyframes, and let no false loop bend them.

iSAM2 takes in every keyframe at once. A loop enters only if it agrees with the estimate, under the
covariance that the estimate has at that moment, and then behind a Cauchy kernel; otherwise it is
held outside. A `RobustSolver` judges all loops of a `snapshot()` together, at its own pace; `apply()`
carries its verdict into iSAM2 by removing factors, restoring them, and dropping the kernel from
those it confirmed.
"""

import logging
import time
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from numpy.typing import NDArray
from scipy.stats import chi2

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.gnss import GnssConfig, GnssDatum, GnssFactor, GnssFix, GnssTie, gnss_factor
from lcd_loop_closure.graph_noise import (
    BROKEN_LINK,
    GraphNoise,
    GraphNoiseConfig,
    between,
    gauge,
    gaussian,
)
from lcd_loop_closure.graph_snapshot import IN_GRAPH, GraphLoop, GraphSnapshot, LoopKey, LoopState
from lcd_loop_closure.incremental_solver import IncrementalConfig, IncrementalSolver
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.loop_ledger import LoopLedger
from lcd_loop_closure.robust_solver import Verdict

_log = logging.getLogger(__name__)


@config
class PoseGraphConfig:
    """When loops enter the graph and how a verdict is carried in."""

    admission_probability: float = setting(
        0.9999, 'share of true loops that agree with the estimate', low=0.5, high=0.9999999
    )
    admission_distance: float = setting(
        10.0, 'loops that ask for a larger shift wait for the solver', unit='m', low=0.0
    )
    admission_angle: float = setting(
        0.35, 'loops that ask for a larger turn wait for the solver', unit='rad', low=0.0
    )
    kernel: float = setting(
        3.0, 'width of the Cauchy kernel of a loop not yet judged, in sigmas', low=0.1
    )
    rebuild_distance: float = setting(
        1.0,
        'a verdict that moves a pose farther rebuilds iSAM2 around its poses',
        unit='m',
        low=0.0,
    )


@dataclass(frozen=True)
class GraphUpdate:
    """What one update did.

    Attributes:
        keyframes: how many keyframes came in.
        loops_in: loops that entered the graph (new, or restored by a verdict).
        loops_out: loops that left the graph (by a verdict, or by hand).
        loops_held: loops that contradict the estimate and wait for the solver.
        links_changed: ids of keyframes whose link to their predecessor was given up or believed
            again.
        max_shift_m: how far the farthest older keyframe moved.
        seconds: wall time.
    """

    keyframes: int
    loops_in: tuple[LoopKey, ...]
    loops_out: tuple[LoopKey, ...]
    loops_held: tuple[LoopKey, ...]
    links_changed: tuple[int, ...]
    max_shift_m: float
    seconds: float


class PoseGraph:
    """Keep the corrected poses of all keyframes by iSAM2; not to be used from two threads at once.

    Args:
        settings: admission of loops.
        noise: covariances where the measurements tell none, and floors where they do.
        incremental: iSAM2.
        gnss: use of satellite fixes.
    """

    def __init__(
        self,
        settings: PoseGraphConfig | None = None,
        noise: GraphNoiseConfig | None = None,
        incremental: IncrementalConfig | None = None,
        gnss: GnssConfig | None = None,
    ) -> None:
        self.settings = settings or PoseGraphConfig()
        self._noise = GraphNoise(noise or GraphNoiseConfig())
        self._incremental = incremental or IncrementalConfig()
        self._gnss = GnssTie(gnss or GnssConfig())
        self._threshold = float(chi2.ppf(self.settings.admission_probability, 6))
        self._careful = False
        self._solver = IncrementalSolver(self._incremental)
        self._ids: list[int] = []
        self._rows: dict[int, int] = {}
        self._stamps_ns: list[int] = []
        self._T_odom_base: list[se3.Array] = []
        self._motions: list[se3.Array] = []
        self._motion_covariances: list[se3.Array] = []
        self._links: list[int] = []
        self._broken: set[int] = set()
        self._ledger = LoopLedger()
        self._loop_handles: dict[LoopKey, int] = {}
        self._waiting: list[LoopKey] = []
        self._taken_out: list[LoopKey] = []
        self._new_keyframes = 0
        self._new_fixes: list[GnssFactor] = []

    def __len__(self) -> int:
        return len(self._ids)

    def add_keyframe(self, keyframe: Keyframe, *, new_session: bool = False) -> None:
        """Append a keyframe, tied to the last one by odometry; its cloud is not kept.

        Where ids leave a gap, the motion is taken from T_odom_base and its covariance grows with it.
        A new session has an odometry and a clock of its own: the motion that its first keyframe has
        is taken as it is, and the stamp may be older.

        Raises:
            DataError: the id or stamp does not increase, or a pose is not finite.
        """
        T_previous_this, covariance = keyframe.T_previous_this, keyframe.motion_covariance
        if not (np.isfinite(T_previous_this).all() and np.isfinite(keyframe.T_odom_base).all()):
            raise DataError(f'expected finite poses, got NaN in keyframe {keyframe.id}; dropped')
        late = bool(self._ids) and not new_session and keyframe.stamp_ns <= self._stamps_ns[-1]
        if late or (self._ids and keyframe.id <= self._ids[-1]):
            raise DataError(
                f'expected a keyframe after {self._ids[-1]} at {self._stamps_ns[-1]} ns, got '
                f'{keyframe.id} at {keyframe.stamp_ns} ns; dropped (was the bag rewound?)'
            )
        if not self._ids:
            T_previous_this, covariance, T_guess = np.eye(4), None, np.eye(4)
        else:
            if keyframe.id != self._ids[-1] + 1 and not new_session:
                T_previous_this = se3.inverse(self._T_odom_base[-1]) @ keyframe.T_odom_base
                covariance = None
            T_guess = self._latest() @ T_previous_this
        row = self._solver.add_pose(T_guess)
        self._newest = T_guess
        self._ids.append(keyframe.id)
        self._rows[keyframe.id] = row
        self._stamps_ns.append(keyframe.stamp_ns)
        self._T_odom_base.append(keyframe.T_odom_base)
        self._motions.append(T_previous_this)
        self._motion_covariances.append(self._noise.odometry(T_previous_this, covariance))
        self._links.append(self._solver.add(self._link_factor(row)))
        self._new_keyframes += 1

    def add_loop(self, loop: LoopConstraint, *, by_hand: bool = False) -> None:
        """Offer a loop; the next update says what becomes of it.

        One that was already rejected is only remembered. By hand: it enters as it is, without a
        kernel, and is never judged. A loop between the same keyframes is replaced.

        Raises:
            DataError: a keyframe is unknown, or an accepted loop has no finite transform.
        """
        key = loop.match_id, loop.query_id
        if not set(key) <= self._rows.keys() or key[0] == key[1]:
            raise DataError(
                f'expected a loop between two of the {len(self)} known keyframes, got {key}; dropped'
            )
        usable = loop.T_match_query is not None and bool(np.isfinite(loop.T_match_query).all())
        if (loop.accepted or by_hand) and not usable:
            raise DataError(f'expected a finite T_match_query in the loop {key}, got none; dropped')
        if key in self._ledger:
            self._take_out(key)
        covariance = self._noise.loop(loop.covariance)
        if by_hand:
            self._ledger.add(loop, covariance, LoopState.BY_HAND)
            self._ledger.decide(key, LoopState.BY_HAND, 'added by hand')
        else:
            state = LoopState.HELD if loop.accepted else LoopState.UNUSED
            self._ledger.add(loop, covariance, state)
        if by_hand or loop.accepted:
            self._waiting.append(key)

    def remove_loop(self, match_id: int, query_id: int) -> bool:
        """Take a loop out for good, at the next update; False when there is none."""
        key = match_id, query_id
        if key not in self._ledger or self._ledger[key].state is LoopState.UNUSED:
            return False
        self._take_out(key)
        self._ledger.decide(key, LoopState.UNUSED, 'removed by hand')
        return True

    def add_gnss(
        self, fix: GnssFix, T_base_antenna: se3.Array, T_keyframe_base: se3.Array | None = None
    ) -> None:
        """Tie the last keyframe to a satellite fix, at the next update.

        T_keyframe_base: motion by odometry from the last keyframe to the time of the fix; None when
        the fix was taken with it.

        Raises:
            DataError: there is no keyframe yet, or the fix cannot be used; the text says why.
        """
        if not self._ids:
            raise DataError('expected a keyframe before the first satellite fix; fix dropped')
        T = T_base_antenna if T_keyframe_base is None else T_keyframe_base @ T_base_antenna
        self._new_fixes.append(self._gnss.add(fix, self._ids[-1], T[:3, 3].copy()))

    def update(self) -> GraphUpdate:
        """Take in all that came since the last update."""
        started = time.perf_counter()
        before = self._solver.poses
        keyframes, out = self._new_keyframes, tuple(self._taken_out)
        loops_in, held, farthest_m = self._admit()
        if keyframes or out or loops_in:
            self._step()
        if farthest_m > self._incremental.relinearize_translation:
            # One linear step does not close a loop that is this far open.
            self._step()
        self._new_keyframes, self._taken_out = 0, []
        self._tie_to_earth()
        return self._report(started, before, keyframes, loops_in, out, held, ())

    def apply(self, verdict: Verdict) -> GraphUpdate:
        """Remove and restore loops and links by a solver's verdict, and update.

        Loops that arrived after the verdict's snapshot, and those put in or out by hand, stay as
        they are.
        """
        started = time.perf_counter()
        before = self._solver.poses
        keyframes = self._new_keyframes
        if keyframes or self._taken_out or self._new_fixes:
            self.update()
        loops_in, out = [], []
        for loop in self._ledger:
            by_hand = loop.state in (LoopState.BY_HAND, LoopState.UNUSED)
            if by_hand or loop.serial >= verdict.arrivals:
                continue
            was_in = loop.state in IN_GRAPH
            if loop.key in verdict.rejected:
                self._take_out(loop.key)
                self._ledger.decide(loop.key, LoopState.REJECTED, verdict.rejected[loop.key])
                out.extend([loop.key] if was_in else [])
            elif loop.key in verdict.accepted and loop.state is not LoopState.CONFIRMED:
                self._take_out(loop.key)
                self._ledger.decide(loop.key, LoopState.CONFIRMED)
                self._put_in(loop.key)
                loops_in.extend([] if was_in else [loop.key])
        self._taken_out = []
        links = self._change_links(verdict)
        self._carry_in(verdict)
        return self._report(started, before, keyframes, loops_in, out, (), links)

    @property
    def needs_verdict(self) -> bool:
        """True when a loop is there that no verdict has judged."""
        return any(loop.state in (LoopState.HELD, LoopState.TENTATIVE) for loop in self._ledger)

    @property
    def ids(self) -> NDArray[np.int64]:
        """Keyframe ids [N], in the order of poses()."""
        return np.array(self._ids, np.int64)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps [N], in the order of poses()."""
        return np.array(self._stamps_ns, np.int64)

    def poses(self) -> se3.Array:
        """Return T_map_base [N x 4 x 4] as of the last update; not to be written to."""
        return self._solver.poses

    @property
    def T_map_odom(self) -> se3.Array:
        """What the graph corrects of odometry at the last keyframe; the identity when empty."""
        if not self._ids:
            return np.eye(4)
        return self._latest() @ se3.inverse(self._T_odom_base[-1])

    def covariance(self, keyframe_id: int) -> se3.Array:
        """Return the 6x6 of T_map_base, body axes, translation first.

        Raises:
            KeyError: no update has taken in such a keyframe.
        """
        row = self._rows[keyframe_id]
        if row >= len(self._solver):
            raise KeyError(keyframe_id)
        return self._solver.pose_covariance(row)

    def loops(self) -> list[LoopConstraint]:
        """Return every loop that was offered, each with the latest verdict, in order of arrival."""
        return [loop.constraint for loop in self._ledger]

    @property
    def broken_links(self) -> tuple[int, ...]:
        """Ids of keyframes whose link to their predecessor was found to be wrong."""
        return tuple(self._ids[row] for row in sorted(self._broken))

    @property
    def gnss_datum(self) -> GnssDatum | None:
        """Origin of the east-north-up frame: the first fix."""
        return self._gnss.datum

    @property
    def T_enu_map(self) -> se3.Array | None:
        """Where the map lies in the east-north-up frame; None before the drive has a baseline."""
        return self._gnss.T_enu_map

    def trajectory(self) -> Trajectory:
        """Return stamps and corrected poses (write_tum, write_kitti)."""
        poses = self.poses()
        return Trajectory(self.stamps_ns[: len(poses)], poses)

    def snapshot(self) -> GraphSnapshot:
        """Return a copy of everything, for the solver or for saving; takes in what waits first."""
        if self._new_keyframes or self._waiting or self._new_fixes or self._taken_out:
            self.update()
        count = len(self._ids)
        return GraphSnapshot(
            self.ids,
            self.stamps_ns,
            np.array(self._T_odom_base).reshape(count, 4, 4),
            self.poses().copy(),
            np.array(self._motions).reshape(count, 4, 4),
            np.array(self._motion_covariances).reshape(count, 6, 6),
            self.broken_links,
            tuple(self._ledger),
            self._ledger.arrivals,
            tuple(self._gnss.factors),
            self._gnss.datum,
            self._gnss.T_enu_map,
        )

    @classmethod
    def restore(
        cls,
        snapshot: GraphSnapshot,
        settings: PoseGraphConfig | None = None,
        noise: GraphNoiseConfig | None = None,
        incremental: IncrementalConfig | None = None,
        gnss: GnssConfig | None = None,
    ) -> 'PoseGraph':
        """Rebuild a graph from a snapshot; loops keep their verdicts."""
        graph = cls(settings, noise, incremental, gnss)
        graph._ids = [int(i) for i in snapshot.ids]
        graph._rows = {i: row for row, i in enumerate(graph._ids)}
        graph._stamps_ns = [int(stamp) for stamp in snapshot.stamps_ns]
        graph._T_odom_base = list(snapshot.T_odom_base)
        graph._motions = list(snapshot.motions)
        graph._motion_covariances = list(snapshot.motion_covariances)
        graph._broken = {snapshot.row(i) for i in snapshot.broken_links}
        graph._ledger = LoopLedger(snapshot.loops, snapshot.arrivals)
        graph._waiting = [loop.key for loop in snapshot.loops if loop.state is LoopState.HELD]
        graph._gnss.factors = list(snapshot.gnss)
        graph._gnss.datum, graph._gnss.T_enu_map = snapshot.gnss_datum, snapshot.T_enu_map
        graph._rebuild(snapshot.T_map_base)
        return graph

    def _latest(self) -> se3.Array:
        known = len(self._solver)
        return self._solver.pose(known - 1) if known == len(self._ids) else self._newest

    def _link_factor(self, row: int) -> gtsam.NonlinearFactor:
        if row == 0:
            free = self._gnss.T_enu_map is not None
            return gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gauge(free=free))
        covariance = BROKEN_LINK if row in self._broken else self._motion_covariances[row]
        return between(X(row - 1), X(row), self._motions[row], gaussian(covariance))

    def _put_in(self, key: LoopKey) -> None:
        loop = self._ledger[key]
        noise = gaussian(loop.covariance)
        if loop.state is LoopState.TENTATIVE:
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(self.settings.kernel)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        match, query = (X(self._rows[i]) for i in key)
        self._loop_handles[key] = self._solver.add(between(match, query, loop.T_match_query, noise))

    def _take_out(self, key: LoopKey) -> None:
        if key in self._waiting:
            self._waiting.remove(key)
        handle = self._loop_handles.pop(key, None)
        if handle is not None:
            self._solver.remove(handle)
            self._taken_out.append(key)

    def _admit(self) -> tuple[list[LoopKey], list[LoopKey], float]:
        """Put waiting loops in that agree with the estimate.

        Return those let in, those held, and the largest shift in metres that one in asks for.
        """
        loops_in, held, farthest_m = [], [], 0.0
        for key in self._waiting:
            loop = self._ledger[key]
            shift_m, against = np.inf, ''
            if loop.state is not LoopState.BY_HAND:
                shift_m, against = self._objection(loop)
            if against:
                self._ledger.decide(key, LoopState.HELD, f'{against}; waits for the solver')
                held.append(key)
                continue
            if loop.state is not LoopState.BY_HAND:
                self._ledger.decide(key, LoopState.TENTATIVE, loop.constraint.reason)
            self._put_in(key)
            loops_in.append(key)
            farthest_m = max(farthest_m, shift_m)
        self._waiting = []
        return loops_in, held, farthest_m

    def _objection(self, loop: GraphLoop) -> tuple[float, str]:
        """Return by how many metres a loop differs from the estimate, and why it may not enter."""
        T_match_query, covariance = self._relative(*(self._rows[i] for i in loop.key))
        error = se3.log(se3.inverse(loop.T_match_query) @ T_match_query)
        sigmas = float(np.sqrt(error @ np.linalg.solve(covariance + loop.covariance, error)))
        metres, radians = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        limit = np.sqrt(self._threshold)
        if sigmas > limit:
            return metres, f'contradicts the estimate by {sigmas:.1f} sigma (limit {limit:.1f})'
        s = self.settings
        if metres > s.admission_distance or radians > s.admission_angle:
            return metres, f'asks for a shift of {metres:.1f} m and {radians:.2f} rad'
        return metres, ''

    def _relative(self, first: int, second: int) -> tuple[se3.Array, se3.Array]:
        """Return T_first_second as estimated and its 6x6; keyframes still to be taken in count too.

        Their part is odometry's, which is what an update would make of it.
        """
        known = len(self._solver)
        if min(first, second) >= known:
            self._step()
            known = len(self._solver)
        if first > second:
            T, covariance = self._relative(second, first)
            return se3.inverse(T), se3.invert_covariance(T, covariance)
        last = min(second, known - 1)
        if first == last:
            T, covariance = np.eye(4), np.zeros((6, 6))
        else:
            T = se3.inverse(self._solver.pose(first)) @ self._solver.pose(last)
            covariance = self._solver.relative_covariance(first, last)
        for row in range(last + 1, second + 1):
            motion = self._motions[row]
            covariance = se3.compose_covariance(covariance, motion, self._motion_covariances[row])
            T = T @ motion
        return T, covariance

    def _tie_to_earth(self) -> None:
        """Put satellite fixes in, once it is known where the map lies among them."""
        fixes, self._new_fixes = self._new_fixes, []
        if not fixes:
            return
        poses = self._solver.poses
        if self._gnss.align(lambda i: poses[self._rows[i]]):
            # From now on the fixes hold the map: the first pose gets the alignment's freedom.
            self._solver.remove(self._links[0])
            self._links[0] = self._solver.add(self._link_factor(0))
            fixes = self._gnss.factors
        if self._gnss.T_enu_map is not None:
            for fix in fixes:
                self._add_fix(fix)
            self._step()

    def _add_fix(self, fix: GnssFactor) -> None:
        assert self._gnss.T_enu_map is not None
        self._solver.add(gnss_factor(fix, self._gnss.T_enu_map, X(self._rows[fix.keyframe_id])))

    def _change_links(self, verdict: Verdict) -> list[int]:
        judged = {row for row in self._broken if self._ids[row] in verdict.judged_ids}
        broken = {self._rows[i] for i in verdict.broken_links}
        changed = sorted(broken ^ judged)
        self._broken = (self._broken - judged) | broken
        for row in changed:
            self._solver.remove(self._links[row])
            self._links[row] = self._solver.add(self._link_factor(row))
            _log.warning(
                'odometry between keyframes %d and %d: %s',
                self._ids[row - 1],
                self._ids[row],
                'contradicted by the loops, given up' if row in broken else 'believed again',
            )
        return [self._ids[row] for row in changed]

    def _carry_in(self, verdict: Verdict) -> None:
        """Update iSAM2, from the verdict's own poses when they are far from where it stands."""
        rows = np.array([self._rows[int(i)] for i in verdict.ids], np.int64)
        poses = self._solver.poses
        shift = np.linalg.norm(verdict.T_map_base[:, :3, 3] - poses[rows, :3, 3], axis=1)
        if len(rows) and shift.max() > self.settings.rebuild_distance:
            last = rows[-1]
            T_new_old = verdict.T_map_base[-1] @ se3.inverse(poses[last])
            self._rebuild(np.concatenate([verdict.T_map_base, T_new_old @ poses[last + 1 :]]))
        else:
            self._step()

    def _step(self) -> None:
        """Let iSAM2 take a step; where Cholesky fails, start afresh with QR and stay with it.

        GTSAM refuses to go on by Cholesky where one direction is known 4096 times worse than
        another, which ten kilometres without a loop, or a link that broke, already make so.
        """
        poses = self._solver.poses
        try:
            self._solver.update()
        except RuntimeError as error:
            if self._careful:
                raise
            _log.info('the pose graph goes on with QR: %s', str(error).strip().partition('\n')[0])
            self._careful = True
            chain = list(poses)
            for row in range(len(chain), len(self._ids)):
                chain.append(chain[-1] @ self._motions[row] if chain else np.eye(4))
            self._rebuild(np.array(chain))

    def _rebuild(self, T_map_base: se3.Array) -> None:
        """Start iSAM2 afresh around the given poses with all that is in the graph."""
        self._solver = IncrementalSolver(self._incremental, careful=self._careful)
        for row, T in enumerate(T_map_base):
            self._solver.add_pose(T)
            if row == 0:
                self._links = []
            self._links.append(self._solver.add(self._link_factor(row)))
        self._loop_handles = {}
        for loop in self._ledger:
            if loop.state in IN_GRAPH:
                self._put_in(loop.key)
        if self._gnss.T_enu_map is not None:
            for fix in self._gnss.factors:
                self._add_fix(fix)
        if len(T_map_base):
            self._step()

    def _report(
        self,
        started: float,
        before: se3.Array,
        keyframes: int,
        loops_in: list[LoopKey],
        out: tuple[LoopKey, ...] | list[LoopKey],
        held: list[LoopKey] | tuple[LoopKey, ...],
        links: list[int] | tuple[int, ...],
    ) -> GraphUpdate:
        moved = self._solver.poses[: len(before), :3, 3] - before[:, :3, 3]
        shift = float(np.sqrt(np.einsum('ij,ij->i', moved, moved).max())) if len(before) else 0.0
        seconds = time.perf_counter() - started
        return GraphUpdate(
            keyframes, tuple(loops_in), tuple(out), tuple(held), tuple(links), shift, seconds
        )
