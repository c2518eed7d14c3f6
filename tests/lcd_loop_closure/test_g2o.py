"""Pose graph files survive a round trip and say what is wrong with them."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.g2o import MeasuredGraph, measured_graph, read_g2o, snapshot_of, write_g2o

IDENTITY = '1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1'


def made_up(count: int = 6) -> MeasuredGraph:
    rng = np.random.default_rng(0)
    poses = np.array([se3.exp(rng.normal(size=6)) for _ in range(count)])
    edges = np.array([*((k, k + 1) for k in range(count - 1)), (0, count - 1)])
    motions = np.array([se3.inverse(poses[i]) @ poses[j] for i, j in edges])
    roots = rng.normal(size=(len(edges), 6, 6))
    covariances = roots @ np.swapaxes(roots, 1, 2) + 0.5 * np.eye(6)
    return MeasuredGraph(np.arange(count), poses, edges, motions, covariances)


def test_g2o_round_trip(tmp_path: Path) -> None:
    graph = made_up()
    write_g2o(tmp_path / 'a.g2o', graph)
    again = read_g2o(tmp_path / 'a.g2o')
    np.testing.assert_array_equal(again.ids, graph.ids)
    np.testing.assert_array_equal(again.edges, graph.edges)
    assert again.T_world_body is not None
    np.testing.assert_allclose(again.T_world_body, graph.T_world_body, atol=1e-12)
    np.testing.assert_allclose(again.T_first_second, graph.T_first_second, atol=1e-12)
    np.testing.assert_allclose(again.covariances, graph.covariances, rtol=1e-8, atol=1e-10)


def test_gtsam_reads_the_same_from_our_file(tmp_path: Path) -> None:
    graph = made_up()
    write_g2o(tmp_path / 'a.g2o', graph)
    factors, values = gtsam.readG2o(str(tmp_path / 'a.g2o'), True)
    for row, T in enumerate(graph.T_world_body if graph.T_world_body is not None else ()):
        np.testing.assert_allclose(values.atPose3(row).matrix(), T, atol=1e-9)
    for k in range(len(graph.edges)):
        factor = factors.at(k)
        np.testing.assert_allclose(factor.measured().matrix(), graph.T_first_second[k], atol=1e-9)
        theirs = se3.covariance_from_gtsam(factor.noiseModel().covariance())
        np.testing.assert_allclose(theirs, graph.covariances[k], rtol=1e-6, atol=1e-9)


def test_toro_angles_are_roll_pitch_yaw(tmp_path: Path) -> None:
    (tmp_path / 'a.txt').write_text(f'EDGE3 0 1 1 2 3 0.1 -0.2 0.3 {IDENTITY}\n')
    T = read_g2o(tmp_path / 'a.txt').T_first_second[0]
    np.testing.assert_allclose(T[:3, :3], gtsam.Rot3.RzRyRx(0.1, -0.2, 0.3).matrix(), atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], [1, 2, 3])


def test_sphere_has_its_published_size_and_noise(real_data: Path) -> None:
    folder = real_data / 'pose_graphs'
    snapshot = snapshot_of(read_g2o(folder / 'sphere2500.txt'))
    truth = snapshot_of(read_g2o(folder / 'sphere2500_groundtruth.txt'))
    assert (len(snapshot), len(snapshot.loops)) == (2500, 2450)
    assert all(q - m == 50 for m, q in (loop.key for loop in snapshot.loops))
    difference = se3.inverse(truth.motions[1:]) @ snapshot.motions[1:]
    assert np.std(difference[:, :3, 3]) == pytest.approx(0.1, rel=0.05)


def test_a_graph_of_ours_goes_out_and_comes_back(tmp_path: Path) -> None:
    snapshot = snapshot_of(made_up())
    write_g2o(tmp_path / 'out.g2o', measured_graph(snapshot))
    again = snapshot_of(read_g2o(tmp_path / 'out.g2o'))
    np.testing.assert_allclose(again.motions, snapshot.motions, atol=1e-12)
    assert not again.loops  # a loop that waits for its verdict is not in the graph


def test_an_edge_backwards_is_turned_round() -> None:
    graph = made_up()
    edges = graph.edges.copy()
    edges[2] = edges[2][::-1]
    T, covariances = graph.T_first_second.copy(), graph.covariances.copy()
    T[2] = se3.inverse(T[2])
    covariances[2] = se3.invert_covariance(graph.T_first_second[2], covariances[2])
    turned = snapshot_of(MeasuredGraph(graph.ids, graph.T_world_body, edges, T, covariances))
    straight = snapshot_of(graph)
    np.testing.assert_allclose(turned.motions, straight.motions, atol=1e-12)
    np.testing.assert_allclose(
        turned.motion_covariances, straight.motion_covariances, atol=1e-9, rtol=1e-9
    )


@pytest.mark.parametrize(
    ('line', 'says'),
    [
        ('EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1', 'unknown kind EDGE_SE2'),
        ('EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 1 0', '21 numbers'),
        ('EDGE_SE3:QUAT 0 1 1 nan 3 0 0 0 1 ' + IDENTITY, 'not a pose'),
        ('EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 0 ' + IDENTITY, 'length'),
        ('EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 ' + IDENTITY.replace('1', '-1'), 'positive definite'),
        ('VERTEX_SE3:QUAT zero 1 2 3 0 0 0 1', 'zero'),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, says: str) -> None:
    (tmp_path / 'bad.g2o').write_text(f'# fine\n{line}\n')
    with pytest.raises(DataError, match=says) as error:
        read_g2o(tmp_path / 'bad.g2o')
    assert 'bad.g2o:2' in str(error.value)


def test_missing_file_and_missing_link(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r'none\.g2o.*check the path'):
        read_g2o(tmp_path / 'none.g2o')
    graph = made_up()
    keep = np.arange(len(graph.edges)) != 2
    broken = MeasuredGraph(
        graph.ids, None, graph.edges[keep], graph.T_first_second[keep], graph.covariances[keep]
    )
    with pytest.raises(DataError, match='between 2 and 3'):
        snapshot_of(broken)
