"""The graph corrects drift, keeps wrong loops out at every moment, and follows verdicts."""

from dataclasses import replace

import numpy as np
import pytest
from back_end_graphs import keys, out_and_back, rmse_m, run_online
from scipy.optimize import least_squares

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.trajectory import read_tum
from lcd_loop_closure.graph_noise import GraphNoise, GraphNoiseConfig, diagonal
from lcd_loop_closure.graph_snapshot import LoopState
from lcd_loop_closure.incremental_solver import IncrementalConfig
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig, Verdict
from lcd_loop_closure.town_graphs import (
    TownGraph,
    TownGraphConfig,
    aliased_false_loops,
    loop_between,
    random_false_loops,
    town_graph,
)

NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))
SOLVER = RobustSolver(RobustSolverConfig())


def fed(drive: TownGraph, count: int | None = None) -> PoseGraph:
    """Return a graph with the keyframes of a drive and no loops."""
    graph = PoseGraph()
    for keyframe in list(drive.keyframes())[:count]:
        graph.add_keyframe(keyframe)
    graph.update()
    return graph


def judged(graph: PoseGraph, **changes: object) -> Verdict:
    """Return a verdict that keeps everything as it is, but for the changes."""
    snapshot = graph.snapshot()
    verdict = Verdict(
        frozenset(), {}, (), snapshot.arrivals, snapshot.ids, snapshot.T_map_base, 0, 0.0
    )
    return replace(verdict, **changes)  # type: ignore[arg-type]


def status_of(graph: PoseGraph, match_id: int, query_id: int) -> LoopStatus:
    return next(c.status for c in graph.loops() if (c.match_id, c.query_id) == (match_id, query_id))


def test_without_loops_the_graph_is_odometry() -> None:
    drive = out_and_back(length=20)
    graph = fed(drive)
    np.testing.assert_allclose(graph.poses(), drive.T_odom_base, atol=1e-9)
    np.testing.assert_allclose(graph.T_map_odom, np.eye(4), atol=1e-9)
    assert graph.trajectory().length_m == pytest.approx(2 * 19 * 2.0, rel=0.02)


def test_an_empty_graph_answers() -> None:
    graph = PoseGraph()
    assert len(graph) == 0 and graph.poses().shape == (0, 4, 4)
    np.testing.assert_array_equal(graph.T_map_odom, np.eye(4))
    assert graph.update().keyframes == 0
    assert graph.loops() == [] and not graph.needs_verdict
    graph.apply(SOLVER.solve(graph.snapshot()))
    assert len(graph.trajectory()) == 0


@pytest.fixture(scope='module')
def small() -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """Return a small solved graph, and scipy's minimum and covariance of the last pose."""
    drive = out_and_back(length=8, seed=5)
    loops = [
        loop_between(i, j, se3.inverse(drive.T_world_base[i]) @ drive.T_world_base[j])
        for i, j in ((0, 15), (3, 12))
    ]
    graph = PoseGraph(
        incremental=IncrementalConfig(
            relinearize_translation=1e-6, relinearize_rotation=1e-6, wildfire=0.0
        )
    )
    for keyframe in drive.keyframes():
        graph.add_keyframe(keyframe)
    for loop in loops:
        graph.add_loop(loop)
    graph.update()
    for _ in range(3):
        graph.apply(judged(graph, accepted=frozenset(keys(tuple(loops)))))
    noise = GraphNoise(GraphNoiseConfig())
    chain = drive.T_odom_base

    def poses_of(x: np.ndarray) -> list[np.ndarray]:
        return [T @ se3.exp(xi) for T, xi in zip(chain, x.reshape(-1, 6), strict=True)]

    def residuals(x: np.ndarray) -> np.ndarray:
        T = poses_of(x)
        out = [se3.log(T[0]) / 1e-3]
        for row in range(1, len(T)):
            covariance = noise.odometry(drive.motions[row], drive.motion_covariances[row])
            error = se3.log(se3.inverse(drive.motions[row]) @ se3.inverse(T[row - 1]) @ T[row])
            out.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
        for loop in loops:
            assert loop.T_match_query is not None
            T_error = se3.inverse(T[loop.match_id] @ loop.T_match_query) @ T[loop.query_id]
            root = np.linalg.cholesky(noise.loop(loop.covariance))
            out.append(np.linalg.solve(root, se3.log(T_error)))
        return np.concatenate(out)

    found = least_squares(residuals, np.zeros(6 * len(drive)), method='lm', xtol=1e-14)
    solved = np.array(poses_of(found.x))
    # The jacobian is in x; where x is small its axes are the body's.
    inverse = np.linalg.inv(found.jac.T @ found.jac)
    return graph, solved, inverse[-6:, -6:]


def test_the_minimum_is_scipy_s(small: tuple[PoseGraph, np.ndarray, np.ndarray]) -> None:
    graph, solved, _ = small
    np.testing.assert_allclose(graph.poses(), solved, atol=1e-5)


def test_the_covariance_is_scipy_s_translation_first(
    small: tuple[PoseGraph, np.ndarray, np.ndarray],
) -> None:
    graph, _, covariance = small
    ours = graph.covariance(15)
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    np.testing.assert_allclose(ours / scale, covariance / scale, atol=0.02)
    with pytest.raises(KeyError):
        graph.covariance(99)


def test_a_true_loop_corrects_the_drift() -> None:
    drive = out_and_back(length=80, seed=2)
    graph, _ = run_online(drive)
    odometry_m, corrected_m = (
        np.linalg.norm(T[-1, :3, 3] - drive.T_world_base[-1, :3, 3])
        for T in (drive.T_odom_base, graph.poses())
    )
    assert odometry_m > 0.5 and corrected_m < 0.1
    assert all(loop.status is LoopStatus.ACCEPTED for loop in graph.loops())
    corrected = graph.T_map_odom @ drive.T_odom_base[-1]
    np.testing.assert_allclose(corrected, graph.poses()[-1], atol=1e-6)


def test_a_wrong_loop_moves_nothing_and_says_why() -> None:
    drive = out_and_back(length=80)
    graph = fed(drive)
    before = graph.poses().copy()
    graph.add_loop(loop_between(5, 70, np.eye(4)))
    update = graph.update()
    assert update.loops_held == ((5, 70),) and update.loops_in == ()
    np.testing.assert_array_equal(graph.poses(), before)
    loop = graph.loops()[0]
    assert loop.status is LoopStatus.REJECTED_INCONSISTENT
    assert 'sigma' in loop.reason and 'waits for the solver' in loop.reason
    assert graph.needs_verdict
    graph.apply(SOLVER.solve(graph.snapshot()))
    assert status_of(graph, 5, 70) is LoopStatus.REJECTED_BY_GRAPH
    assert not graph.needs_verdict
    np.testing.assert_allclose(graph.poses(), before, atol=1e-6)


@pytest.mark.parametrize('kind', ['random', 'aliased'])
def test_wrong_loops_arriving_one_by_one_bend_no_moment(kind: str) -> None:
    town = town_graph(TownGraphConfig(keyframes=350), seed=0)
    make = random_false_loops if kind == 'random' else aliased_false_loops
    wrong = make(town, 15, 11)
    clean, clean_m = run_online(town)
    graph, errors_m = run_online(town.with_loops(wrong))
    np.testing.assert_allclose(errors_m, clean_m, atol=0.05)
    accepted = {(c.match_id, c.query_id) for c in graph.loops() if c.accepted}
    assert accepted == keys(town.loops)
    assert rmse_m(graph.poses(), town.T_world_base) <= 1.05 * rmse_m(
        clean.poses(), town.T_world_base
    )


def test_a_verdict_removes_restores_and_leaves_alone_what_came_meanwhile() -> None:
    drive = out_and_back(length=60)
    graph = fed(drive)
    T = drive.T_world_base

    def true_loop(match: int, query: int) -> None:
        graph.add_loop(loop_between(match, query, se3.inverse(T[match]) @ T[query]))

    true_loop(20, 99)
    true_loop(30, 89)
    graph.update()
    with_both = graph.poses().copy()
    snapshot = graph.snapshot()
    # Meanwhile: a new loop, and the first one again, measured anew.
    true_loop(10, 109)
    true_loop(20, 99)
    graph.update()
    verdict = Verdict(
        frozenset({(30, 89)}),
        {(20, 99): 'for the test'},
        (),
        snapshot.arrivals,
        snapshot.ids,
        snapshot.T_map_base,
        0,
        0.0,
    )
    update = graph.apply(verdict)
    assert update.loops_out == ()  # (20, 99) came again after the snapshot
    states = {loop.key: loop.state for loop in graph.snapshot().loops}
    assert states == {
        (30, 89): LoopState.CONFIRMED,
        (10, 109): LoopState.TENTATIVE,
        (20, 99): LoopState.TENTATIVE,
    }
    update = graph.apply(judged(graph, rejected={(20, 99): 'gone', (10, 109): 'gone'}))
    assert set(update.loops_out) == {(20, 99), (10, 109)}
    assert status_of(graph, 20, 99) is LoopStatus.REJECTED_BY_GRAPH
    only = fed(drive)
    only.add_loop(loop_between(30, 89, se3.inverse(T[30]) @ T[89]))
    only.update()
    only.apply(judged(only, accepted=frozenset({(30, 89)})))
    for _ in range(3):
        only.apply(judged(only))
        graph.apply(judged(graph))
    np.testing.assert_allclose(graph.poses(), only.poses(), atol=2e-3)
    update = graph.apply(judged(graph, accepted=frozenset({(20, 99)})))
    assert update.loops_in == ((20, 99),)
    assert status_of(graph, 20, 99) is LoopStatus.ACCEPTED
    assert with_both.shape == graph.poses().shape


def test_keyframes_that_came_after_a_far_verdict_move_with_the_map() -> None:
    drive = out_and_back().with_broken_link(60, se3.exp([0.5, 0.5, 0, 0, 0, 2.0]))
    graph = fed(drive, 110)
    for loop in drive.loops:
        if loop.query_id < 110:
            graph.add_loop(loop)
    graph.update()
    assert all(loop.status is LoopStatus.REJECTED_INCONSISTENT for loop in graph.loops())
    verdict = SOLVER.solve(graph.snapshot())
    for keyframe in list(drive.keyframes())[110:]:
        graph.add_keyframe(keyframe)
    update = graph.apply(verdict)
    assert len(graph.broken_links) == 1 and update.links_changed == graph.broken_links
    assert update.max_shift_m > 10.0
    assert rmse_m(graph.poses(), drive.T_world_base) < 0.6
    graph.apply(replace(verdict, broken_links=(), accepted=frozenset()))
    assert graph.broken_links == ()


@pytest.mark.parametrize('declared', [True, False])
def test_a_turn_that_breaks_odometry_is_repaired_online(declared: bool) -> None:
    drive = out_and_back(declared=declared).with_broken_link(60, se3.rotation_z(np.pi * 0.9))
    graph, _ = run_online(drive)
    assert bool(graph.broken_links) != declared
    assert rmse_m(graph.poses(), drive.T_world_base) < 0.6
    assert all(loop.status is LoopStatus.ACCEPTED for loop in graph.loops())


def test_a_person_may_add_and_remove_loops() -> None:
    drive = out_and_back(length=60)
    graph = fed(drive)
    wrong = loop_between(5, 70, drive.T_odom_base[3])
    graph.add_loop(wrong, by_hand=True)
    assert graph.update().loops_in == ((5, 70),)
    assert not graph.needs_verdict
    graph.apply(SOLVER.solve(graph.snapshot()))
    assert status_of(graph, 5, 70) is LoopStatus.ACCEPTED
    assert graph.remove_loop(5, 70)
    assert graph.update().loops_out == ((5, 70),)
    for _ in range(5):
        graph.apply(judged(graph))
    np.testing.assert_allclose(graph.poses(), drive.T_odom_base, atol=1e-3)
    assert status_of(graph, 5, 70) is LoopStatus.REJECTED_BY_HAND
    assert not graph.remove_loop(5, 70) and not graph.remove_loop(1, 2)
    graph.apply(judged(graph, accepted=frozenset({(5, 70)})))
    assert status_of(graph, 5, 70) is LoopStatus.REJECTED_BY_HAND


def test_a_loop_removed_before_its_update_never_enters() -> None:
    drive = out_and_back(length=60)
    graph = fed(drive)
    graph.add_loop(loop_between(5, 114, np.eye(4)))
    assert graph.remove_loop(5, 114)
    assert graph.update().loops_in == ()


def test_rejected_loops_are_remembered_and_unused() -> None:
    drive = out_and_back(length=60)
    graph = fed(drive)
    rejected = replace(
        loop_between(5, 114, np.eye(4)), status=LoopStatus.REJECTED_OVERLAP, T_match_query=None
    )
    graph.add_loop(rejected)
    graph.update()
    assert graph.loops() == [rejected] and not graph.needs_verdict
    assert SOLVER.solve(graph.snapshot()).rejected == {}


def test_what_cannot_be_used_is_refused_with_a_reason() -> None:
    drive = out_and_back(length=10)
    graph = fed(drive)
    keyframe = next(iter(drive.keyframes()))
    nan = np.full((4, 4), np.nan)
    late = replace(keyframe, id=50, stamp_ns=2**62)
    for bad, says in (
        (keyframe, 'was the bag rewound'),
        (replace(keyframe, id=50), 'was the bag rewound'),
        (replace(late, T_previous_this=nan), 'finite poses'),
        (replace(late, T_odom_base=nan), 'finite poses'),
    ):
        with pytest.raises(DataError, match=says):
            graph.add_keyframe(bad)
    for loop, says in (
        (loop_between(0, 99, np.eye(4)), 'known|keyframes'),
        (loop_between(4, 4, np.eye(4)), 'keyframes'),
        (loop_between(0, 9, nan), 'finite T_match_query'),
        (replace(loop_between(0, 9, nan), T_match_query=None), 'finite T_match_query'),
    ):
        with pytest.raises(DataError, match=says):
            graph.add_loop(loop)
    graph.update()
    np.testing.assert_allclose(graph.poses(), drive.T_odom_base, atol=1e-9)


def test_a_missing_keyframe_is_bridged_by_the_odometry_pose() -> None:
    drive = out_and_back(length=10)
    graph = PoseGraph()
    for keyframe in drive.keyframes():
        if keyframe.id not in (4, 5):
            graph.add_keyframe(keyframe)
    graph.update()
    kept = [i for i in range(len(drive)) if i not in (4, 5)]
    np.testing.assert_array_equal(graph.ids, kept)
    np.testing.assert_allclose(graph.poses(), drive.T_odom_base[kept], atol=1e-9)


def test_a_new_session_starts_where_it_is_told() -> None:
    drive = out_and_back(length=10)
    graph = fed(drive)
    T_last_this = se3.exp([1.0, 2.0, 0, 0, 0, 0.5])
    first = Keyframe(40, 5, np.eye(4), T_last_this, diagonal(1.0, 0.1), NO_POINTS)
    graph.add_keyframe(first, new_session=True)
    graph.update()
    np.testing.assert_allclose(graph.poses()[-1], graph.poses()[-2] @ T_last_this, atol=1e-9)


def test_a_restored_graph_goes_on_alike() -> None:
    town = town_graph(TownGraphConfig(keyframes=300), seed=0)
    wrong = random_false_loops(town, 5, 1)
    graph, _ = run_online(town.with_loops(wrong))
    again = PoseGraph.restore(graph.snapshot())
    np.testing.assert_allclose(again.poses(), graph.poses(), atol=5e-3)
    assert again.loops() == graph.loops()
    T_last = town.T_odom_base[-1]
    keyframe = Keyframe(300, 2**62, T_last, np.eye(4), None, NO_POINTS)
    for each in (graph, again):
        each.add_keyframe(keyframe)
        each.update()
    np.testing.assert_allclose(again.poses()[-1], graph.poses()[-1], atol=5e-3)
    np.testing.assert_allclose(again.T_map_odom, graph.T_map_odom, atol=5e-3)


def test_the_same_drive_gives_the_same_graph_bit_for_bit() -> None:
    town = town_graph(TownGraphConfig(keyframes=250), seed=3)
    drive = town.with_loops(random_false_loops(town, 10, 4))
    (first, _), (second, _) = run_online(drive), run_online(drive)
    np.testing.assert_array_equal(first.poses(), second.poses())
    assert first.loops() == second.loops()


def test_a_very_uncertain_drive_goes_on_with_another_factorization() -> None:
    """Cholesky gives up where one direction is 4096 times less sure than another."""
    motion = se3.exp([2.0, 0, 0, 0, 0, 0])
    graph = PoseGraph()
    for k in range(80):
        covariance = diagonal(20.0, 3.0) if k == 20 else diagonal(1e-3, 1e-5)
        T = np.linalg.matrix_power(motion, k)
        graph.add_keyframe(Keyframe(k, k + 1, T, motion if k else np.eye(4), covariance, NO_POINTS))
        graph.update()
    expected = [np.linalg.matrix_power(motion, k) for k in range(80)]
    np.testing.assert_allclose(graph.poses(), expected, atol=1e-6)


def test_the_trajectory_is_written_for_other_tools(tmp_path) -> None:
    drive = out_and_back(length=10)
    graph = fed(drive)
    graph.trajectory().write_tum(tmp_path / 'a.txt')
    again = read_tum(tmp_path / 'a.txt')
    np.testing.assert_allclose(again.T_world_body, graph.poses(), atol=1e-7)
    np.testing.assert_array_equal(again.stamps_ns, graph.stamps_ns)
