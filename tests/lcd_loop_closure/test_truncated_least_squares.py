"""Our graduated non-convexity ends where GTSAM's own does, and chooses what costs less."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from back_end_graphs import snapshot_of_drive
from scipy.stats import chi2

from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.town_graphs import TownGraphConfig, random_false_loops, town_graph
from lcd_loop_closure.truncated_least_squares import TruncatedLeastSquares
from lcd_loop_closure.weighted_graph import WeightedGraph, poses_of

THRESHOLD = float(chi2.ppf(0.99, 6))


@pytest.fixture(scope='module')
def snapshot() -> GraphSnapshot:
    town = town_graph(TownGraphConfig(keyframes=450), seed=0)
    return snapshot_of_drive(town.with_loops(random_false_loops(town, 6, 0)))


def test_weights_and_poses_are_those_of_gtsam_s_gnc(snapshot: GraphSnapshot) -> None:
    count = len(snapshot.loops)
    graph = WeightedGraph(snapshot)
    problem = TruncatedLeastSquares(graph, THRESHOLD, np.zeros(count, bool))
    ours = problem.minimise(snapshot.T_map_base, cauchy_scale=1.0, mu=0.02, factor=1.4)
    # GTSAM's, from the same Cauchy solve, with the same known inliers and threshold.
    start = WeightedGraph(snapshot)
    start.solve_cauchy(1.0, np.ones(count, bool))
    factors = start._graph(np.ones(count))
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(factors.size() - count)))
    optimizer = gtsam.GncLMOptimizer(factors, start._values, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    theirs = poses_of(optimizer.optimize())
    np.testing.assert_allclose(ours.weights, optimizer.getWeights()[-count:], atol=1e-3)
    np.testing.assert_allclose(ours.poses, theirs, atol=1e-3)


def test_the_cost_is_the_truncated_sum(snapshot: GraphSnapshot) -> None:
    graph = WeightedGraph(snapshot)
    problem = TruncatedLeastSquares(graph, THRESHOLD, np.zeros(len(snapshot.loops), bool))
    minimum = problem.minimise(snapshot.T_map_base, 1.0, 0.02, 2.0)
    residuals = graph.residuals()
    assert (residuals[minimum.weights > 0] <= THRESHOLD).all()
    assert (residuals[minimum.weights == 0] > THRESHOLD).all()
    expected = graph.anchor_cost() + np.minimum(residuals, THRESHOLD).sum()
    assert minimum.cost == pytest.approx(expected)
    everything = problem.settle(np.ones(len(residuals)), minimum.poses)
    assert everything.cost >= minimum.cost - 1e-6


def test_a_fixed_loop_stays_whatever_it_costs(snapshot: GraphSnapshot) -> None:
    wrong = [k for k, loop in enumerate(snapshot.loops) if loop.constraint.method == 'false']
    fixed = np.zeros(len(snapshot.loops), bool)
    fixed[wrong[0]] = True
    problem = TruncatedLeastSquares(WeightedGraph(snapshot), THRESHOLD, fixed)
    assert problem.minimise(snapshot.T_map_base, 1.0, 0.02, 2.0).weights[wrong[0]] == 1.0


def test_the_cost_of_one_more_loop_is_foretold(snapshot: GraphSnapshot) -> None:
    """The distance under the solution's covariance is what taking the loop in really costs."""
    true = [k for k, loop in enumerate(snapshot.loops) if loop.constraint.method == 'true']
    weights = np.zeros(len(snapshot.loops))
    weights[true[:-1]] = 1.0
    graph = WeightedGraph(snapshot)
    graph.settle(weights, 30, 1e-9)
    before = graph.anchor_cost() + float(weights @ graph.residuals())
    foretold = graph.distances(weights, np.array([true[-1]]))[0]
    weights[true[-1]] = 1.0
    graph.settle(weights, 30, 1e-9)
    after = graph.anchor_cost() + float(weights @ graph.residuals())
    assert after - before == pytest.approx(foretold, rel=0.02)


def test_a_loosened_link_costs_nothing_and_can_be_tightened(snapshot: GraphSnapshot) -> None:
    snapshot = replace(snapshot, loops=())
    graph = WeightedGraph(snapshot)
    assert graph.anchor_cost() == pytest.approx(0.0, abs=1e-6)
    bent = snapshot.T_map_base.copy()
    bent[100:, :3, 3] += [0.0, 1.0, 0.0]
    graph.poses = bent
    stiff = graph.anchor_cost()
    graph.loosen(100)
    assert graph.anchor_cost() < 0.01 < stiff and graph.loose_rows == [100]
    graph.tighten(100)
    assert graph.anchor_cost() == pytest.approx(stiff)
