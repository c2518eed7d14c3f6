"""Wrong loops are found, true ones kept, and a broken link is told from a look-alike street."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from back_end_graphs import keys, out_and_back, rmse_m, snapshot_of_drive
from evo.core.geometry import umeyama_alignment

from lcd_common import se3
from lcd_loop_closure.g2o import read_g2o, snapshot_of
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.graph_snapshot import GraphLoop, GraphSnapshot, LoopState
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig
from lcd_loop_closure.town_graphs import (
    TownGraph,
    TownGraphConfig,
    aliased_false_loops,
    loop_between,
    random_false_loops,
    town_graph,
)
from lcd_loop_closure.weighted_graph import WeightedGraph

SOLVER = RobustSolver(RobustSolverConfig())


@pytest.fixture(scope='module')
def town() -> TownGraph:
    return town_graph(TownGraphConfig(keyframes=500), seed=0)


@pytest.fixture(scope='module')
def clean_m(town: TownGraph) -> float:
    return rmse_m(SOLVER.solve(snapshot_of_drive(town)).T_map_base, town.T_world_base)


@pytest.mark.parametrize('count', [1, 20, 100])
def test_random_wrong_loops_do_not_bend_a_town(town: TownGraph, clean_m: float, count: int) -> None:
    wrong = random_false_loops(town, count, seed=7)
    verdict = SOLVER.solve(snapshot_of_drive(town.with_loops(wrong)))
    assert verdict.accepted == keys(town.loops)
    assert verdict.rejected.keys() == keys(wrong)
    assert rmse_m(verdict.T_map_base, town.T_world_base) <= 1.05 * clean_m
    assert all('sigma' in reason for reason in verdict.rejected.values())


def test_look_alike_streets_do_not_bend_a_town(town: TownGraph, clean_m: float) -> None:
    wrong = aliased_false_loops(town, 15, seed=3)
    verdict = SOLVER.solve(snapshot_of_drive(town.with_loops(wrong)))
    assert verdict.accepted == keys(town.loops)
    assert not verdict.broken_links
    assert rmse_m(verdict.T_map_base, town.T_world_base) <= 1.05 * clean_m


def test_the_clean_solve_is_that_of_gtsam(town: TownGraph) -> None:
    # Oracle: Levenberg-Marquardt of GTSAM on the plain least squares with all true loops.
    snapshot = snapshot_of_drive(town)
    everything = WeightedGraph(snapshot)._graph(np.ones(len(snapshot.loops)))
    values = gtsam.Values()
    for row, T in enumerate(snapshot.T_map_base):
        values.insert(row, gtsam.Pose3(T))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    solved = gtsam.LevenbergMarquardtOptimizer(everything, values, params).optimize()
    ours = SOLVER.solve(snapshot).T_map_base
    for row in range(0, len(town), 50):
        np.testing.assert_allclose(ours[row], solved.atPose3(row).matrix(), atol=1e-4)


def test_sphere_with_twenty_wrong_loops(real_data: Path) -> None:
    folder = real_data / 'pose_graphs'
    snapshot = snapshot_of(read_g2o(folder / 'sphere2500.txt'))
    truth = snapshot_of(read_g2o(folder / 'sphere2500_groundtruth.txt')).T_odom_base
    made_up = TownGraph(truth, truth, truth, ())
    wrong = tuple(
        GraphLoop(loop, snapshot.loops[0].covariance, LoopState.HELD)
        for loop in random_false_loops(made_up, 20, seed=0)
    )
    verdict = SOLVER.solve(replace(snapshot, loops=snapshot.loops + wrong))
    assert verdict.accepted == {loop.key for loop in snapshot.loops}
    R, t, _ = umeyama_alignment(verdict.T_map_base[:, :3, 3].T, truth[:, :3, 3].T)
    aligned = se3.from_rotation_translation(R, t) @ verdict.T_map_base
    assert rmse_m(aligned, truth) < 0.25
    assert rmse_m(snapshot.T_odom_base, truth) > 20.0


@pytest.mark.parametrize('seed', [0, 1])
def test_a_link_that_broke_silently_is_given_up(seed: int) -> None:
    drive = out_and_back(seed=seed)
    fine = SOLVER.solve(snapshot_of_drive(drive))
    broken = drive.with_broken_link(60, se3.exp([1.0, 0.5, 0, 0, 0, 2.5]))
    verdict = SOLVER.solve(snapshot_of_drive(broken))
    assert len(verdict.broken_links) == 1 and abs(verdict.broken_links[0] - 60) <= 2
    assert verdict.accepted == keys(drive.loops)
    clean_m = rmse_m(fine.T_map_base, drive.T_world_base)
    assert rmse_m(verdict.T_map_base, drive.T_world_base) < 1.1 * clean_m + 0.05
    assert rmse_m(broken.T_odom_base, drive.T_world_base) > 20.0


def test_a_link_that_said_so_is_bridged_by_the_loops() -> None:
    drive = out_and_back(declared=True).with_broken_link(60, se3.rotation_z(np.pi))
    verdict = SOLVER.solve(snapshot_of_drive(drive))
    assert verdict.accepted == keys(drive.loops)
    assert not verdict.broken_links
    assert rmse_m(verdict.T_map_base, drive.T_world_base) < 0.5


@pytest.mark.parametrize('count', [15, 40])
def test_a_look_alike_street_breaks_no_link_where_nothing_else_speaks(count: int) -> None:
    """One long drive without a single true loop: odometry stands against the street alone."""
    drive = replace(out_and_back(length=200), loops=())
    wrong = aliased_false_loops(drive, count, seed=1, min_distance=60.0)
    verdict = SOLVER.solve(snapshot_of_drive(drive.with_loops(wrong)))
    assert not verdict.accepted and not verdict.broken_links
    assert rmse_m(verdict.T_map_base, drive.T_odom_base) < 1e-6


def test_true_loops_bring_a_link_back() -> None:
    drive = out_and_back()
    snapshot = replace(snapshot_of_drive(drive), broken_links=(60,))
    assert SOLVER.solve(snapshot).broken_links == ()


def test_a_few_loops_do_not_break_a_link() -> None:
    drive = out_and_back().with_broken_link(60, se3.rotation_z(2.0))
    few = replace(drive, loops=drive.loops[20:26])
    verdict = SOLVER.solve(snapshot_of_drive(few))
    assert not verdict.accepted and not verdict.broken_links


def test_covariances_that_are_far_too_large_do_not_hide_wrong_loops() -> None:
    """As in parking-garage: every factor says 1 m and 0.5 rad, and means centimetres."""
    town = town_graph(TownGraphConfig(keyframes=400, streets=3, loop_share=1.0), seed=4)
    wrong = random_false_loops(town, 10, seed=5)
    snapshot = snapshot_of_drive(town.with_loops(wrong))
    vague = diagonal(1.0, 0.5)
    snapshot = replace(
        snapshot,
        motion_covariances=np.tile(vague, (len(town), 1, 1)),
        loops=tuple(replace(loop, covariance=vague) for loop in snapshot.loops),
    )
    verdict = SOLVER.solve(snapshot)
    assert not verdict.accepted & keys(wrong)
    assert len(verdict.accepted) >= 0.95 * len(town.loops)


def test_a_loop_by_hand_is_believed_and_an_unused_one_is_not_judged(town: TownGraph) -> None:
    wrong = random_false_loops(town, 2, seed=9)
    snapshot = snapshot_of_drive(town.with_loops(wrong))
    states = {
        (wrong[0].match_id, wrong[0].query_id): LoopState.BY_HAND,
        (wrong[1].match_id, wrong[1].query_id): LoopState.UNUSED,
    }
    loops = tuple(replace(loop, state=states.get(loop.key, loop.state)) for loop in snapshot.loops)
    verdict = SOLVER.solve(replace(snapshot, loops=loops))
    assert (wrong[0].match_id, wrong[0].query_id) in verdict.accepted
    unused = wrong[1].match_id, wrong[1].query_id
    assert unused not in verdict.accepted and unused not in verdict.rejected


def test_the_same_snapshot_gives_the_same_verdict_bit_for_bit(town: TownGraph) -> None:
    snapshot = snapshot_of_drive(town.with_loops(random_false_loops(town, 20, seed=2)))
    first, second = (SOLVER.solve(snapshot) for _ in range(2))
    np.testing.assert_array_equal(first.T_map_base, second.T_map_base)
    assert (first.accepted, first.rejected) == (second.accepted, second.rejected)


def test_graphs_without_loops_or_keyframes_are_no_special_case() -> None:
    drive = replace(out_and_back(length=5), loops=())
    verdict = SOLVER.solve(snapshot_of_drive(drive))
    np.testing.assert_allclose(verdict.T_map_base, drive.T_odom_base, atol=1e-9)
    none = np.zeros((0, 4, 4))
    empty = GraphSnapshot(
        np.zeros(0, np.int64), np.zeros(0, np.int64), none, none, none, np.zeros((0, 6, 6))
    )
    assert len(SOLVER.solve(empty).T_map_base) == 0


def test_a_single_loop_after_a_long_drift_is_believed() -> None:
    drive = out_and_back(length=150, seed=3)
    one = replace(
        drive,
        loops=(loop_between(0, 299, se3.inverse(drive.T_world_base[0]) @ drive.T_world_base[299]),),
    )
    verdict = SOLVER.solve(snapshot_of_drive(one))
    assert verdict.accepted == keys(one.loops)
    before = rmse_m(drive.T_odom_base, drive.T_world_base)
    assert rmse_m(verdict.T_map_base, drive.T_world_base) < before
