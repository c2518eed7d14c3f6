"""Cycles of loops and odometry are judged by the covariance that odometry really has."""

import tracemalloc

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.pairwise_consistency import (
    ChainCovariance,
    LoopMeasurements,
    adjoints,
    agreeing_groups,
    cycle_distances,
    log,
    odometry_distances,
)
from lcd_loop_closure.town_graphs import chain


def drive(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    motions = np.array([se3.exp([2.0, 0, 0, *rng.normal(0, 0.1, 3)]) for _ in range(count)])
    motions[0] = np.eye(4)
    covariances = np.array([diagonal(0.02, 0.003) * rng.uniform(0.5, 2) for _ in range(count)])
    return motions, covariances


def loops_of(poses: np.ndarray, ends: list[tuple[int, int]]) -> LoopMeasurements:
    T = np.array([se3.inverse(poses[i]) @ poses[j] for i, j in ends])
    return LoopMeasurements(np.array(ends), T, np.tile(diagonal(0.05, 0.01), (len(ends), 1, 1)))


def test_array_forms_equal_the_scalar_ones() -> None:
    rng = np.random.default_rng(3)
    xi = rng.normal(size=(50, 6))
    xi[0] = 0.0
    xi[1, 3:] = 1e-7
    xi[2, 3:] = [0.0, 3.1, 0.0]
    T = np.array([se3.exp(x) for x in xi])
    np.testing.assert_allclose(log(T), [se3.log(t) for t in T], atol=1e-9)
    np.testing.assert_allclose(adjoints(T), [se3.adjoint(t) for t in T], atol=1e-12)


@pytest.mark.parametrize(('first', 'second'), [(3, 17), (17, 3), (0, 19), (8, 8)])
def test_the_chain_has_the_covariance_of_composing_link_by_link(first: int, second: int) -> None:
    motions, covariances = drive(20)
    poses = chain(motions)
    low, high = sorted((first, second))
    T, expected = np.eye(4), np.zeros((6, 6))
    for row in range(low + 1, high + 1):
        expected = se3.compose_covariance(expected, motions[row], covariances[row])
        T = T @ motions[row]
    if first > second:
        expected, T = se3.invert_covariance(T, expected), se3.inverse(T)
    measured = ChainCovariance(poses, covariances)
    rows = np.array([first]), np.array([second])
    np.testing.assert_allclose(measured.covariance(*rows)[0], expected, atol=1e-12)
    np.testing.assert_allclose(measured.motion(*rows)[0], T, atol=1e-12)


def test_distances_of_true_loops_follow_chi_square() -> None:
    # Oracle: drawn odometry and loops; six degrees of freedom make a mean of six.
    motions, covariances = drive(40)
    truth = chain(motions)
    ends = [(2, 33), (5, 30)]
    rng = np.random.default_rng(4)
    cycles, singles = [], []
    for _ in range(150):
        noise = [se3.exp(np.linalg.cholesky(c) @ rng.normal(size=6)) for c in covariances]
        noise[0] = np.eye(4)
        estimate = chain(motions @ np.array(noise))
        exact = loops_of(truth, ends)
        drawn = [se3.exp(np.sqrt(np.diag(c)) * rng.normal(size=6)) for c in exact.covariances]
        loops = LoopMeasurements(
            exact.ends, exact.T_match_query @ np.array(drawn), exact.covariances
        )
        measured = ChainCovariance(estimate, covariances)
        cycles.append(cycle_distances(measured, loops, np.array([0]), np.array([1]))[0])
        singles.append(odometry_distances(measured, loops)[0])
    assert np.mean(cycles) == pytest.approx(6.0, abs=0.9)
    assert np.mean(singles) == pytest.approx(6.0, abs=0.9)


def test_groups_are_the_loops_that_agree() -> None:
    motions, covariances = drive(100)
    poses = chain(motions)
    true = [(5, 60), (8, 63), (11, 66)]
    alias = [(20, 80), (22, 82)]
    loops = loops_of(poses, [*true, *alias, (30, 90)])
    T = loops.T_match_query.copy()
    wrong = poses[20] @ se3.exp([1.0, 0, 0, 0, 0, 0.3]) @ se3.inverse(poses[80])
    for k, (i, j) in enumerate(alias, start=3):
        T[k] = se3.inverse(poses[i]) @ wrong @ poses[j]
    T[5] = se3.exp([0, 0, 0, 0, 0, 2.0])
    measured = LoopMeasurements(loops.ends, T, loops.covariances)
    groups = agreeing_groups(ChainCovariance(poses, covariances), measured, 22.0, reach=20)
    assert [group.tolist() for group in groups] == [[0, 1, 2], [3, 4]]
    assert agreeing_groups(ChainCovariance(poses, covariances), loops_of(poses, []), 22.0) == []


def test_many_loops_are_compared_in_little_memory_and_as_by_brute_force() -> None:
    motions, covariances = drive(1500)
    poses = chain(motions)
    rng = np.random.default_rng(2)
    ends = np.column_stack([rng.integers(0, 700, 3000), rng.integers(700, 1500, 3000)])
    measured = loops_of(poses, [tuple(pair) for pair in ends.tolist()])
    for wrong in rng.choice(3000, 1500, replace=False).tolist():
        measured.T_match_query[wrong, :3, 3] += rng.uniform(20.0, 60.0, 3)
    by = ChainCovariance(poses, covariances)
    tracemalloc.start()
    groups = agreeing_groups(by, measured, 22.0, reach=15)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6, 'every loop with every other one would take 140 MB'
    agreeing = set()
    for one in range(3000):
        other = np.flatnonzero(np.abs(ends - ends[one]).max(axis=1) <= 15)
        other = other[other > one]
        near = cycle_distances(by, measured, np.full(len(other), one), other) <= 22.0
        agreeing |= {(one, int(two)) for two in other[near]}
    assert len(agreeing) > 1000
    number = {loop: n for n, group in enumerate(groups) for loop in group.tolist()}
    assert all(number[one] == number[two] for one, two in agreeing)
    assert {loop for pair in agreeing for loop in pair} == set(number)
