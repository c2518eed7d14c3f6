"""Hold the factors of a pose graph in iSAM2, by what they stand for."""

import logging

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from lcd_common import se3
from lcd_loop_closure.gnss import GnssFactor, GnssTie, gnss_factor
from lcd_loop_closure.graph_noise import BROKEN_LINK, between, gauge, gaussian
from lcd_loop_closure.graph_snapshot import IN_GRAPH, GraphLoop, LoopKey, LoopState
from lcd_loop_closure.imu_tie import ImuTie
from lcd_loop_closure.incremental_solver import IncrementalConfig, IncrementalSolver
from lcd_loop_closure.loop_ledger import LoopLedger
from lcd_loop_closure.neighbouring_loop import covariance_by_neighbour
from lcd_loop_closure.odometry_chain import OdometryChain

_log = logging.getLogger(__name__)


class GraphFactors:
    """Put measurements in and out of iSAM2, and start it afresh where it must be.

    Args:
        odometry: links and their covariances; its rows are iSAM2's.
        ledger: loops; those in the graph are put in again after a fresh start.
        gnss: satellite fixes, in the graph once T_enu_map is known.
        settings: iSAM2.
        kernel: width of the Cauchy kernel of a loop not yet judged, in sigmas.
    """

    def __init__(
        self,
        odometry: OdometryChain,
        ledger: LoopLedger,
        gnss: GnssTie,
        settings: IncrementalConfig,
        kernel: float,
    ) -> None:
        self.imu: ImuTie | None = None
        self.broken_rows: set[int] = set()
        self.T_map_first: se3.Array = np.eye(4)
        self._odometry, self._ledger, self._gnss = odometry, ledger, gnss
        self._settings, self._kernel = settings, kernel
        self._careful = False
        self._solver = IncrementalSolver(settings)
        self._links: list[int] = []
        self._loops: dict[LoopKey, int] = {}
        self._newest: se3.Array = np.eye(4)

    def __len__(self) -> int:
        """Count the poses that steps have taken in."""
        return len(self._solver)

    @property
    def poses(self) -> se3.Array:
        """Estimates [N x 4 x 4] after the last step; not to be written to."""
        return self._solver.poses

    def latest(self) -> se3.Array:
        """Return the last pose; where no step has taken it in, odometry's continuation."""
        known = len(self._solver)
        if not known or known < len(self._odometry):
            return self._newest
        return self._solver.pose(known - 1)

    def append(self, *, new_session: bool) -> None:
        """Add the pose and the link of odometry's last row."""
        row = len(self._odometry) - 1
        stamps_ns = self._odometry.stamps_ns
        T_previous = self._newest if len(self._solver) < row else self._last_known()
        if row:
            T = T_previous @ self._odometry.motions[row]
        else:
            level = self.imu.level(stamps_ns[0]) if self.imu else None
            T = self.T_map_first = np.eye(4) if level is None else level
        self._solver.add_pose(T)
        self._newest = T
        self._links.append(self._solver.add(self._link(row)))
        if self.imu is not None:
            if row and not new_session:
                self.imu.collect(self._solver, row, stamps_ns[row - 1], stamps_ns[row])
            self.imu.tie(self._solver, row, T_previous, T)

    def put_in(self, loop: GraphLoop) -> None:
        """Add a loop, behind a kernel while it is tentative."""
        noise = gaussian(loop.covariance)
        if loop.state is LoopState.TENTATIVE:
            kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(self._kernel)
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        match, query = (X(self._odometry.row(i)) for i in loop.key)
        self._loops[loop.key] = self._solver.add(between(match, query, loop.T_match_query, noise))

    def take_out(self, key: LoopKey) -> bool:
        """Remove a loop; False when it is not in the graph."""
        handle = self._loops.pop(key, None)
        if handle is not None:
            self._solver.remove(handle)
        return handle is not None

    def set_broken(self, rows: set[int]) -> None:
        """Let the links of these rows say next to nothing, and all others what odometry said."""
        for row in sorted(self.broken_rows ^ rows):
            self.broken_rows ^= {row}
            self._renew_link(row)

    def free_first_pose(self) -> None:
        """Let satellite fixes say where the map lies; once T_enu_map is known."""
        self._renew_link(0)

    def add_fix(self, fix: GnssFactor) -> None:
        """Add a satellite fix; once T_enu_map is known."""
        assert self._gnss.T_enu_map is not None
        row = self._odometry.row(fix.keyframe_id)
        self._solver.add(gnss_factor(fix, self._gnss.T_enu_map, X(row)))

    def step(self) -> None:
        """Let iSAM2 take a step; where Cholesky fails, start afresh with QR and stay with it.

        GTSAM refuses to go on by Cholesky where one direction is known 4096 times worse than
        another, which ten kilometres without a loop, or a link that broke, already make so.
        """
        poses = self._solver.poses_read
        try:
            self._solver.update()
        except RuntimeError as error:
            if self._careful:
                raise
            _log.info('the pose graph goes on with QR: %s', str(error).strip().partition('\n')[0])
            self._careful = True
            chain = list(poses)
            for motion in self._odometry.motions[len(chain) :]:
                chain.append(chain[-1] @ motion if chain else self.T_map_first)
            self.rebuild(np.array(chain))

    def rebuild(self, T_map_base: se3.Array) -> None:
        """Start iSAM2 afresh around the given poses with all that is in the graph."""
        self._solver = IncrementalSolver(self._settings, careful=self._careful)
        self._links, self._loops = [], {}
        for row, T in enumerate(T_map_base):
            self._solver.add_pose(T)
            self._links.append(self._solver.add(self._link(row)))
            if self.imu is not None:
                self.imu.tie(self._solver, row, T_map_base[max(row - 1, 0)], T)
        for loop in self._ledger:
            if loop.state in IN_GRAPH:
                self.put_in(loop)
        for fix in self._gnss.factors if self._gnss.T_enu_map is not None else ():
            self.add_fix(fix)
        if len(T_map_base):
            self.step()

    def covariance(self, row: int) -> se3.Array:
        """Return the 6x6 of a pose, body axes, translation first."""
        return self._solver.pose_covariance(row)

    def relative_pose(self, first: int, second: int) -> se3.Array:
        """Return T_first_second as estimated.

        Rows still to be taken in count too; their part is odometry's, which is what a step would
        make of it.
        """
        if first > second:
            return se3.inverse(self.relative_pose(second, first))
        if first >= len(self._solver):
            self.step()
        last = min(second, len(self._solver) - 1)
        T = np.eye(4)
        if first < last:
            T = se3.inverse(self._solver.pose(first)) @ self._solver.pose(last)
        for row in range(last + 1, second + 1):
            T = T @ self._odometry.motions[row]
        return T

    def doubt(self, loop: GraphLoop) -> float:
        """Return by how much the kernel widens a loop's covariance at the estimate; 1: not."""
        if loop.state is not LoopState.TENTATIVE:
            return 1.0
        estimate = self.relative_pose(*(self._odometry.row(i) for i in loop.key))
        error = se3.log(se3.inverse(loop.T_match_query) @ estimate)
        squared = float(error @ np.linalg.solve(loop.covariance, error))
        return 1.0 + squared / self._kernel**2

    def loop_covariance(self, key: LoopKey) -> se3.Array:
        """Return the 6x6 of the relative pose that a loop measures, or a bound by a near loop."""
        bound = covariance_by_neighbour(
            self._ledger, self._odometry, self.broken_rows, key, self.doubt
        )
        if bound is not None:
            return bound
        return self.relative_covariance(*(self._odometry.row(i) for i in key))

    def relative_covariance(self, first: int, second: int) -> se3.Array:
        """Return the 6x6 of `relative_pose`, body axes of the second, translation first."""
        if first > second:
            T, covariance = (
                self.relative_pose(second, first),
                self.relative_covariance(second, first),
            )
            return se3.invert_covariance(T, covariance)
        if first >= len(self._solver):
            self.step()
        last = min(second, len(self._solver) - 1)
        covariance = np.zeros((6, 6))
        if first < last:
            covariance = self._solver.relative_covariance(first, last)
        for row in range(last + 1, second + 1):
            motion, noise = self._odometry.motions[row], self._odometry.covariances[row]
            covariance = se3.compose_covariance(covariance, motion, noise)
        return covariance

    def _last_known(self) -> se3.Array:
        known = len(self._solver)
        return self._solver.pose(known - 1) if known else np.eye(4)

    def _link(self, row: int) -> gtsam.NonlinearFactor:
        if row == 0:
            noise = gauge(free=self._gnss.T_enu_map is not None, level=self.imu is not None)
            return gtsam.PriorFactorPose3(X(0), gtsam.Pose3(self.T_map_first), noise)
        covariance = BROKEN_LINK if row in self.broken_rows else self._odometry.covariances[row]
        return between(X(row - 1), X(row), self._odometry.motions[row], gaussian(covariance))

    def _renew_link(self, row: int) -> None:
        self._solver.remove(self._links[row])
        self._links[row] = self._solver.add(self._link(row))
