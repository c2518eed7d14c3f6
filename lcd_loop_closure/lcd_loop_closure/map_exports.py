"""Write a map's result in the formats that other tools read."""

from pathlib import Path

import numpy as np

from lcd_common.trajectory import Trajectory
from lcd_loop_closure.g2o import MeasuredGraph, write_g2o
from lcd_loop_closure.graph_snapshot import IN_GRAPH, GraphSnapshot


def write_exports(graph: GraphSnapshot, folder: Path) -> None:
    """Write trajectory.tum, poses_kitti.txt and graph.g2o of a graph.

    The trajectory is in the order of its stamps, so that a map of several sessions is readable too;
    rows of the KITTI file are in the order of the ids. The graph has odometry's links and the loops
    that are in it.
    """
    trajectory(graph).write_tum(folder / 'trajectory.tum')
    rows = graph.T_map_base[:, :3].reshape(len(graph), 12)
    np.savetxt(folder / 'poses_kitti.txt', rows, fmt='%.9e')
    write_g2o(folder / 'graph.g2o', measured(graph))


def trajectory(graph: GraphSnapshot) -> Trajectory:
    """Return the corrected poses by stamp; of equal stamps the first id stays."""
    stamps_ns, first = np.unique(graph.stamps_ns, return_index=True)
    return Trajectory(stamps_ns, graph.T_map_base[first])


def measured(graph: GraphSnapshot) -> MeasuredGraph:
    """Return poses, odometry's links and the loops that are in the graph."""
    loops = [loop for loop in graph.loops if loop.state in IN_GRAPH]
    links = np.stack([graph.ids[:-1], graph.ids[1:]], axis=1)
    edges = np.array([loop.key for loop in loops], np.int64).reshape(-1, 2)
    motions = [loop.constraint.T_match_query for loop in loops]
    covariances = [loop.covariance for loop in loops]
    return MeasuredGraph(
        graph.ids,
        graph.T_map_base,
        np.concatenate([links, edges]),
        np.concatenate([graph.motions[1:], np.array(motions, float).reshape(-1, 4, 4)]),
        np.concatenate(
            [graph.motion_covariances[1:], np.array(covariances, float).reshape(-1, 6, 6)]
        ),
    )
