"""Keep the corrected poses of all keyframes, and let no false loop bend them.

iSAM2 takes in every keyframe at once. A loop enters only if it agrees with the estimate, under the
covariance that the estimate has at that moment, and then behind a Cauchy kernel; otherwise it is
held outside. A `RobustSolver` judges all loops of a `snapshot()` together, at its own pace;
`apply()` carries its verdict into iSAM2 by removing factors, restoring them, and dropping the
kernel from those it confirmed.
"""

import logging
import time
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.admission import Admission, PoseGraphConfig
from lcd_loop_closure.gnss import GnssConfig, GnssDatum, GnssFactor, GnssFix, GnssTie
from lcd_loop_closure.graph_factors import GraphFactors
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig
from lcd_loop_closure.graph_snapshot import IN_GRAPH, GraphSnapshot, LoopKey, LoopState
from lcd_loop_closure.graph_update import GraphUpdate
from lcd_loop_closure.imu_preintegration import ImuConfig, ImuSample
from lcd_loop_closure.imu_tie import ImuTie
from lcd_loop_closure.incremental_solver import IncrementalConfig
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.loop_ledger import LoopLedger
from lcd_loop_closure.odometry_chain import OdometryChain
from lcd_loop_closure.robust_solver import Verdict

_log = logging.getLogger(__name__)


class PoseGraph:
    """Keep the corrected poses of all keyframes by iSAM2. Not thread-safe.

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
        self._admission = Admission(self.settings)
        self._odometry = OdometryChain(self._noise)
        self._ledger = LoopLedger()
        self._factors = GraphFactors(
            self._odometry, self._ledger, self._gnss, self._incremental, self.settings.kernel
        )
        self._waiting: list[LoopKey] = []
        self._taken_out: list[LoopKey] = []
        self._new_keyframes = 0
        self._new_fixes: list[GnssFactor] = []

    def __len__(self) -> int:
        return len(self._odometry)

    def add_keyframe(self, keyframe: Keyframe, *, new_session: bool = False) -> None:
        """Append a keyframe, tied to the last one by odometry; its cloud is not kept.

        Where ids leave a gap, the motion is taken from T_odom_base, its covariance grows with it.
        A new session has an odometry and a clock of its own: the motion that its first keyframe has
        is taken as it is, and the stamp may be older.

        Raises:
            DataError: the id or stamp does not increase, or a pose is not finite.
        """
        self._odometry.add(keyframe, new_session=new_session)
        self._factors.append(new_session=new_session)
        self._new_keyframes += 1

    def add_loop(self, loop: LoopConstraint, *, by_hand: bool = False) -> None:
        """Offer a loop; the next update says what becomes of it.

        One that was already rejected is only remembered. By hand: it enters as it is, without a
        kernel, and is never judged. A loop between the same keyframes is replaced.

        Raises:
            DataError: a keyframe is unknown, or an accepted loop has no finite transform.
        """
        key = loop.match_id, loop.query_id
        if key[0] not in self._odometry or key[1] not in self._odometry or key[0] == key[1]:
            raise DataError(
                f'expected a loop between two of the {len(self)} keyframes, got {key}; dropped'
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

    def use_imu(self, settings: ImuConfig, T_base_imu: se3.Array) -> None:
        """Tie keyframes by an inertial sensor too, and level the first one by gravity.

        Raises:
            ConfigError: there are keyframes already.
        """
        if len(self):
            raise ConfigError('the inertial sensor must be set up before the first keyframe')
        self._factors.imu = ImuTie(settings, T_base_imu)

    def add_imu(self, sample: ImuSample) -> bool:
        """Take an inertial sample; False when it is not finite, not newer, or not wanted."""
        imu = self._factors.imu
        return imu is not None and imu.add(sample)

    def add_gnss(
        self, fix: GnssFix, T_base_antenna: se3.Array, T_keyframe_base: se3.Array | None = None
    ) -> None:
        """Tie the last keyframe to a satellite fix, at the next update.

        T_keyframe_base: motion from the last keyframe to the fix; None when taken with it.

        Raises:
            DataError: there is no keyframe yet, or the fix cannot be used; the text says why.
        """
        if not self._odometry.ids:
            raise DataError('expected a keyframe before the first satellite fix; fix dropped')
        T = T_base_antenna if T_keyframe_base is None else T_keyframe_base @ T_base_antenna
        self._new_fixes.append(self._gnss.add(fix, self._odometry.ids[-1], T[:3, 3].copy()))

    def update(self) -> GraphUpdate:
        """Take in all that came since the last update."""
        started = time.perf_counter()
        before = self._factors.poses
        keyframes, out = self._new_keyframes, tuple(self._taken_out)
        loops_in, held, farthest_m = self._admit()
        if keyframes or out or loops_in:
            self._factors.step()
        if farthest_m > self._incremental.relinearize_translation:
            # One linear step does not close a loop that is this far open.
            self._factors.step()
        self._new_keyframes, self._taken_out = 0, []
        self._tie_to_earth()
        return self._report(started, before, keyframes, loops_in, out, held, ())

    def apply(self, verdict: Verdict) -> GraphUpdate:
        """Remove and restore loops and links by a solver's verdict, and update.

        Loops that arrived after the verdict's snapshot, and those put in or out by hand, stay as
        they are.
        """
        started = time.perf_counter()
        before = self._factors.poses
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
                self._factors.put_in(self._ledger[loop.key])
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
        return np.array(self._odometry.ids, np.int64)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps [N], in the order of poses()."""
        return np.array(self._odometry.stamps_ns, np.int64)

    def poses(self) -> se3.Array:
        """Return T_map_base [N x 4 x 4] as of the last update; not to be written to."""
        return self._factors.poses

    @property
    def T_map_odom(self) -> se3.Array:
        """What the graph corrects of odometry at the last keyframe; the identity when empty."""
        if not self._odometry.ids:
            return np.eye(4)
        return self._factors.latest() @ se3.inverse(self._odometry.T_odom_base[-1])

    def covariance(self, keyframe_id: int) -> se3.Array:
        """Return the 6x6 of T_map_base, body axes, translation first.

        Raises:
            KeyError: no update has taken in such a keyframe.
        """
        row = self._odometry.row(keyframe_id)
        if row >= len(self._factors):
            raise KeyError(keyframe_id)
        return self._factors.covariance(row)

    def loops(self) -> list[LoopConstraint]:
        """Return every loop that was offered, each with the latest verdict, in order of arrival."""
        return [loop.constraint for loop in self._ledger]

    @property
    def broken_links(self) -> tuple[int, ...]:
        """Ids of keyframes whose link to their predecessor was found to be wrong."""
        return tuple(self._odometry.ids[row] for row in sorted(self._factors.broken_rows))

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
        ids, stamps_ns, T_odom_base, motions, covariances = self._odometry.arrays()
        return GraphSnapshot(
            ids,
            stamps_ns,
            T_odom_base,
            self.poses().copy(),
            motions,
            covariances,
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
        for row, keyframe_id in enumerate(snapshot.ids.tolist()):
            graph._odometry.restore(
                keyframe_id,
                int(snapshot.stamps_ns[row]),
                snapshot.T_odom_base[row],
                snapshot.motions[row],
                snapshot.motion_covariances[row],
            )
        graph._ledger.restore(snapshot.loops, snapshot.arrivals)
        graph._waiting = [loop.key for loop in snapshot.loops if loop.state is LoopState.HELD]
        graph._gnss.factors = list(snapshot.gnss)
        graph._gnss.datum, graph._gnss.T_enu_map = snapshot.gnss_datum, snapshot.T_enu_map
        graph._factors.broken_rows = {snapshot.row(i) for i in snapshot.broken_links}
        if len(snapshot):
            graph._factors.T_map_first = snapshot.T_map_base[0]
        graph._factors.rebuild(snapshot.T_map_base)
        return graph

    def _take_out(self, key: LoopKey) -> None:
        if key in self._waiting:
            self._waiting.remove(key)
        if self._factors.take_out(key):
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
                estimate = self._factors.relative_pose(*(self._odometry.row(i) for i in key))
                covariance = partial(self._factors.loop_covariance, key)
                shift_m, against = self._admission.objection(loop, estimate, covariance)
            if against:
                self._ledger.decide(key, LoopState.HELD, f'{against}; waits for the solver')
                held.append(key)
                continue
            if loop.state is not LoopState.BY_HAND:
                self._ledger.decide(key, LoopState.TENTATIVE, loop.constraint.reason)
            self._factors.put_in(self._ledger[key])
            loops_in.append(key)
            farthest_m = max(farthest_m, shift_m)
        self._waiting = []
        return loops_in, held, farthest_m

    def _tie_to_earth(self) -> None:
        """Put satellite fixes in, once it is known where the map lies among them."""
        fixes, self._new_fixes = self._new_fixes, []
        if not fixes:
            return
        poses = self._factors.poses
        if self._gnss.align(lambda i: poses[self._odometry.row(i)]):
            # From now on the fixes hold the map: the first pose gets the alignment's freedom.
            self._factors.free_first_pose()
            fixes = self._gnss.factors
        if self._gnss.T_enu_map is not None:
            for fix in fixes:
                self._factors.add_fix(fix)
            self._factors.step()

    def _change_links(self, verdict: Verdict) -> list[int]:
        """Give up and believe again links as the verdict has them; return the changed ids."""
        judged = verdict.judged_ids
        before = self._factors.broken_rows.copy()
        later = {row for row in before if self._odometry.ids[row] not in judged}
        broken = {self._odometry.row(i) for i in verdict.broken_links}
        self._factors.set_broken(later | broken)
        changed = sorted(before ^ (later | broken))
        for row in changed:
            what = 'contradicted by the loops, given up' if row in broken else 'believed again'
            between = self._odometry.ids[row - 1 : row + 1]
            _log.warning('odometry between keyframes %d and %d: %s', *between, what)
        return [self._odometry.ids[row] for row in changed]

    def _carry_in(self, verdict: Verdict) -> None:
        """Update iSAM2, from the verdict's own poses when they are far from where it stands."""
        if not len(verdict.ids):
            return
        rows = np.array([self._odometry.row(int(i)) for i in verdict.ids], np.int64)
        poses = self._factors.poses
        shift_m = np.linalg.norm(verdict.T_map_base[:, :3, 3] - poses[rows, :3, 3], axis=1)
        if shift_m.max() > self.settings.rebuild_distance:
            last = rows[-1]
            T_new_old = verdict.T_map_base[-1] @ se3.inverse(poses[last])
            after = T_new_old @ poses[last + 1 :]
            self._factors.rebuild(np.concatenate([verdict.T_map_base, after]))
        else:
            self._factors.step()

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
        moved = self._factors.poses[: len(before), :3, 3] - before[:, :3, 3]
        shift = float(np.sqrt(np.einsum('ij,ij->i', moved, moved).max())) if len(before) else 0.0
        changes = tuple(loops_in), tuple(out), tuple(held), tuple(links)
        return GraphUpdate(keyframes, *changes, shift, time.perf_counter() - started)
