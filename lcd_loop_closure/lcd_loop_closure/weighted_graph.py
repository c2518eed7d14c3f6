"""Solve a graph of relative poses in which each loop has a weight."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.gnss import gnss_factor
from lcd_loop_closure.graph_noise import BROKEN_LINK, between, gauge, gaussian
from lcd_loop_closure.graph_snapshot import GraphSnapshot

_SETTLED = 1e-4
Weights = NDArray[np.float64]


class WeightedGraph:
    """The factors of a snapshot as GTSAM's, solved from where the last solve ended.

    Loops carry weights 0..1 that scale their information; odometry and satellite fixes do not. The
    keys of GTSAM are the rows of the snapshot.
    """

    def __init__(self, snapshot: GraphSnapshot) -> None:
        self._links = [
            between(row - 1, row, snapshot.motions[row], gaussian(snapshot.motion_covariances[row]))
            for row in range(1, len(snapshot))
        ]
        self._loose_links: dict[int, gtsam.BetweenFactorPose3] = {}
        self._gnss = [
            gnss_factor(fix, snapshot.T_enu_map, snapshot.row(fix.keyframe_id))
            for fix in snapshot.gnss
            if snapshot.T_enu_map is not None
        ]
        # Satellite fixes say where the map lies; without any the first pose does.
        self._gauge = gauge(free=bool(self._gnss))
        self.ends = np.array(
            [[snapshot.row(i) for i in loop.key] for loop in snapshot.loops], np.int64
        ).reshape(-1, 2)
        self._T_match_query = [loop.T_match_query for loop in snapshot.loops]
        self._covariances = [loop.covariance for loop in snapshot.loops]
        self._loops = [
            between(int(i), int(j), T, gaussian(covariance))
            for (i, j), T, covariance in zip(
                self.ends, self._T_match_query, self._covariances, strict=True
            )
        ]
        self._start = gtsam.Pose3(snapshot.T_map_base[0] if len(snapshot) else np.eye(4))
        self._values = values_of(snapshot.T_map_base)
        self.iterations = 0
        self._ordering: gtsam.Ordering | None = None
        for keyframe_id in snapshot.broken_links:
            self.loosen(snapshot.row(keyframe_id))

    @property
    def poses(self) -> se3.Array:
        """Solved poses T_map_base [N x 4 x 4]."""
        return poses_of(self._values)

    @poses.setter
    def poses(self, T_map_base: se3.Array) -> None:
        self._values = values_of(T_map_base)

    @property
    def loose_rows(self) -> list[int]:
        """Rows whose link to the previous one says next to nothing."""
        return sorted(self._loose_links)

    def loosen(self, row: int) -> None:
        """Let the link to the previous row say next to nothing."""
        link = self._links[row - 1]
        self._loose_links[row] = link.cloneWithNewNoiseModel(gaussian(BROKEN_LINK))

    def tighten(self, row: int) -> None:
        """Believe the link to the previous row again."""
        del self._loose_links[row]

    def residuals(self) -> Weights:
        """Return the squared Mahalanobis distance of every loop, by its own covariance alone."""
        return np.array([2.0 * loop.error(self._values) for loop in self._loops])

    def anchor_cost(self) -> float:
        """Return twice the negative log-likelihood of all that is no loop."""
        factors = (*self._believed_links(), *self._gnss)
        return 2.0 * float(sum(factor.error(self._values) for factor in factors))

    def solve_cauchy(self, scale: float, judged: NDArray[np.bool_], iterations: int = 30) -> None:
        """Minimise with a Cauchy kernel on the judged loops, by Levenberg-Marquardt."""
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(scale)
        graph = self._anchors()
        for loop, robust in zip(self._loops, judged, strict=True):
            if robust:
                noise = gtsam.noiseModel.Robust.Create(kernel, loop.noiseModel())
                graph.add(loop.cloneWithNewNoiseModel(noise))
            else:
                graph.add(loop)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(iterations)
        params.setRelativeErrorTol(1e-3)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, params)
        try:
            self._values = optimizer.optimize()
        except RuntimeError:  # too far from isotropic for Cholesky
            params.setLinearSolverType('MULTIFRONTAL_QR')
            optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, params)
            self._values = optimizer.optimize()
        self.iterations += optimizer.iterations()

    def step(self, weights: Weights) -> float:
        """Take one Gauss-Newton step; return the largest move of a pose, metres or radians."""
        graph = self._graph(weights)
        linear = graph.linearize(self._values)
        if self._ordering is None:
            # Of all loops: it serves every choice of weights.
            everything = self._graph(np.ones(len(self._loops)))
            self._ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(everything)
        try:
            delta = linear.optimize(self._ordering)
        except RuntimeError:  # too far from isotropic for Cholesky
            delta = linear.optimize(self._ordering, gtsam.EliminateQR)
        self._values = self._values.retract(delta)
        self.iterations += 1
        return float(np.abs(delta.vector()).max())

    def settle(self, weights: Weights, iterations: int = 10, tolerance: float = _SETTLED) -> None:
        """Take Gauss-Newton steps until nothing moves."""
        for _ in range(iterations):
            if self.step(weights) < tolerance:
                return

    def distances(self, weights: Weights, loops: NDArray[np.int64]) -> Weights:
        """Return what taking in each of the loops [K] alone would cost, to first order.

        That is its squared Mahalanobis distance from the solution, under its own covariance and the
        solution's.
        """
        try:
            marginals = gtsam.Marginals(self._graph(weights), self._values)
        except RuntimeError:  # too far from isotropic for Cholesky: nothing can be excluded
            return np.zeros(len(loops))
        poses = self.poses
        out = np.empty(len(loops))
        for n, k in enumerate(loops):
            i, j = (int(row) for row in self.ends[k])
            joint = marginals.jointMarginalCovariance([i, j])
            relative = relative_covariance(poses[i], poses[j], joint, i, j)
            T_error = se3.inverse(self._T_match_query[k]) @ se3.inverse(poses[i]) @ poses[j]
            error = se3.log(T_error)
            out[n] = error @ np.linalg.solve(relative + self._covariances[k], error)
        return out

    def _anchors(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.PriorFactorPose3(0, self._start, self._gauge))
        for factor in (*self._believed_links(), *self._gnss):
            graph.add(factor)
        return graph

    def _believed_links(self) -> list[gtsam.BetweenFactorPose3]:
        return [self._loose_links.get(row, link) for row, link in enumerate(self._links, start=1)]

    def _graph(self, weights: Weights) -> gtsam.NonlinearFactorGraph:
        graph = self._anchors()
        for k, weight in enumerate(weights):
            if weight >= 1.0:
                graph.add(self._loops[k])
            elif weight > 1e-12:
                noise = gaussian(self._covariances[k] / weight)
                graph.add(self._loops[k].cloneWithNewNoiseModel(noise))
        return graph


def values_of(poses: se3.Array) -> gtsam.Values:
    """Return GTSAM's values of poses [N x 4 x 4], keyed by row."""
    values = gtsam.Values()
    for row, T in enumerate(poses):
        values.insert(row, gtsam.Pose3(T))
    return values


def poses_of(values: gtsam.Values) -> se3.Array:
    """Return poses [N x 4 x 4] of GTSAM's values, in the order of the keys."""
    rows = gtsam.utilities.extractPose3(values)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses


def relative_covariance(
    T_map_first: se3.Array,
    T_map_second: se3.Array,
    joint: gtsam.JointMarginal,
    first: int,
    second: int,
) -> se3.Array:
    """Return the 6x6 of T_first_second from the joint marginal of both poses' keys.

    Body axes of the second, translation first.
    """
    blocks = [
        [se3.covariance_from_gtsam(joint.at(a, b)) for b in (first, second)]
        for a in (first, second)
    ]
    T_second_first = se3.inverse(T_map_second) @ T_map_first
    jacobian = np.hstack([-se3.adjoint(T_second_first), np.eye(6)])
    covariance: se3.Array = jacobian @ np.block(blocks) @ jacobian.T
    return 0.5 * (covariance + covariance.T)
