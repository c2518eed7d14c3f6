"""Minimise the truncated least squares of a graph: each loop costs its residual, or a constant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.weighted_graph import WeightedGraph, Weights

_BINARY = 1e-6
_ROUNDS = 8


@dataclass(frozen=True)
class Minimum:
    """A local minimum: poses T_map_base, which loops are right (weight 1 or 0), and its cost."""

    poses: se3.Array
    weights: Weights
    cost: float


class TruncatedLeastSquares:
    """Minimise by graduated non-convexity (Yang et al., RA-L 2020) with warm Gauss-Newton steps.

    Args:
        graph: the factors; odometry and satellite fixes in it are known inliers.
        threshold: squared Mahalanobis distance that a false loop costs.
        fixed: [M] loops that are right whatever they cost.
    """

    def __init__(self, graph: WeightedGraph, threshold: float, fixed: NDArray[np.bool_]) -> None:
        self.graph = graph
        self.threshold = threshold
        self.fixed = fixed

    def minimise(self, start: se3.Array, cauchy_scale: float, mu: float, factor: float) -> Minimum:
        """Return the minimum that a Cauchy solve from `start` and growing mu lead to."""
        graph = self.graph
        graph.poses = start
        graph.solve_cauchy(cauchy_scale, ~self.fixed)
        weights = np.zeros(len(self.fixed))
        for _ in range(100):
            weights = self._graduated(graph.residuals(), mu)
            graph.step(weights)
            mu *= factor
            if np.all((weights < _BINARY) | (weights > 1.0 - _BINARY)):
                break
        return self.settle()

    def settle(self, weights: Weights | None = None, poses: se3.Array | None = None) -> Minimum:
        """Alternate solving and choosing until the choice stays; start from the given ones."""
        graph = self.graph
        if poses is not None:
            graph.poses = poses
        if weights is not None:
            graph.settle(weights)
        weights = self._chosen()
        for _ in range(_ROUNDS):
            graph.settle(weights)
            chosen = self._chosen()
            if np.array_equal(chosen, weights):
                break
            weights = chosen
        residuals = graph.residuals()
        costs = np.where(self.fixed, residuals, np.minimum(residuals, self.threshold))
        return Minimum(graph.poses, weights, graph.anchor_cost() + float(costs.sum()))

    def _chosen(self) -> Weights:
        return (self.fixed | (self.graph.residuals() <= self.threshold)).astype(np.float64)

    def _graduated(self, residuals: Weights, mu: float) -> Weights:
        """Return the weights of the surrogate with control parameter mu (their equation 14)."""
        r = np.sqrt(np.maximum(residuals, 1e-12) / self.threshold)
        weights = np.clip(np.sqrt(mu * (mu + 1.0)) / r - mu, 0.0, 1.0)
        return np.where(self.fixed, 1.0, weights)
