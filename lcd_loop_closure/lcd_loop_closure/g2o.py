"""Read and write pose graphs as .g2o and TORO text, the formats of the public data sets.

`VERTEX_SE3:QUAT id x y z qx qy qz qw` and `EDGE_SE3:QUAT i j x y z qx qy qz qw` are g2o's;
`VERTEX3 id x y z roll pitch yaw` and `EDGE3 i j x y z roll pitch yaw` are TORO's (sphere2500), with
R = Rz(yaw) Ry(pitch) Rx(roll). An edge ends with the upper triangle of its information matrix,
translation first. Rotational information is taken per radian, as GTSAM and Ceres do.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.graph_snapshot import IN_GRAPH, GraphLoop, GraphSnapshot, LoopKey, LoopState
from lcd_loop_closure.loop import LoopConstraint

_UPPER = np.triu_indices(6)


@dataclass(frozen=True)
class MeasuredGraph:
    """Poses and the relative measurements between them.

    Attributes:
        ids: [N] int64, increasing.
        T_world_body: [N x 4 x 4]; None when the file has no vertices.
        edges: [M x 2] int64 ids, first and second.
        T_first_second: [M x 4 x 4].
        covariances: [M x 6 x 6], body axes of the second, translation first.
    """

    ids: NDArray[np.int64]
    T_world_body: se3.Array | None
    edges: NDArray[np.int64]
    T_first_second: se3.Array
    covariances: se3.Array


def read_g2o(path: Path) -> MeasuredGraph:
    """Read a .g2o or TORO file; lines of other kinds (FIX, 2D, landmarks) are refused.

    Raises:
        DataError: the file is missing or a line is not what it says.
    """
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise DataError(
            f'{path}: expected a .g2o or TORO file: {error.strerror}; check the path'
        ) from None
    vertices: dict[int, se3.Array] = {}
    edges, motions, covariances = [], [], []
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if not fields or fields[0].startswith('#') or fields[0] == 'FIX':
            continue
        try:
            if fields[0] in _VERTICES:
                vertices[int(fields[1])] = _pose(fields[2 : 2 + _VERTICES[fields[0]]])
            elif fields[0] in _EDGES:
                size = _EDGES[fields[0]]
                edges.append((int(fields[1]), int(fields[2])))
                motions.append(_pose(fields[3 : 3 + size]))
                covariances.append(_covariance(fields[3 + size :]))
            else:
                raise ValueError(f'unknown kind {fields[0]}')
        except (ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise DataError(
                f'{path}:{number}: expected a 3D vertex or edge with its information: {error}'
            ) from None
    ids = np.array(sorted(vertices) or sorted({i for edge in edges for i in edge}), np.int64)
    return MeasuredGraph(
        ids,
        np.array([vertices[int(i)] for i in ids]) if vertices else None,
        np.array(edges, np.int64).reshape(-1, 2),
        np.array(motions).reshape(-1, 4, 4),
        np.array(covariances).reshape(-1, 6, 6),
    )


def write_g2o(path: Path, graph: MeasuredGraph) -> None:
    """Write vertices (where known) and edges; floats keep all their digits."""
    with path.open('w') as file:
        if graph.T_world_body is not None:
            for i, T in zip(graph.ids, graph.T_world_body, strict=True):
                file.write(f'VERTEX_SE3:QUAT {i} {_numbers(_quaternion_pose(T))}\n')
        for (i, j), T, covariance in zip(
            graph.edges, graph.T_first_second, graph.covariances, strict=True
        ):
            information = np.linalg.inv(covariance)[_UPPER]
            values = _numbers([*_quaternion_pose(T), *information])
            file.write(f'EDGE_SE3:QUAT {i} {j} {values}\n')


_VERTICES = {'VERTEX_SE3:QUAT': 7, 'VERTEX3': 6}
_EDGES = {'EDGE_SE3:QUAT': 7, 'EDGE3': 6}


def _pose(fields: list[str]) -> se3.Array:
    values = np.array([float(v) for v in fields])
    if len(values) not in (6, 7) or not np.isfinite(values).all():
        raise ValueError(f'not a pose: {" ".join(fields)}')
    if len(values) == 7:
        return se3.from_xyz_quaternion(values[:3], values[3:])
    turn_x, turn_y, turn_z = (se3.so3_exp(axis) for axis in np.diag(values[3:]))
    return se3.from_rotation_translation(turn_z @ turn_y @ turn_x, values[:3])


def _covariance(fields: list[str]) -> se3.Array:
    if len(fields) != 21:
        raise ValueError(f'the information needs 21 numbers, got {len(fields)}')
    information = np.zeros((6, 6))
    information[_UPPER] = [float(v) for v in fields]
    information = information + np.triu(information, 1).T
    if not se3.is_covariance(information):
        raise ValueError('the information matrix is not positive definite')
    covariance = np.linalg.inv(information)
    return 0.5 * (covariance + covariance.T)


def _quaternion_pose(T: se3.Array) -> list[float]:
    return [*T[:3, 3], *se3.quaternion_from_rotation(T[:3, :3])]


def _numbers(values: Iterable[float]) -> str:
    return ' '.join(repr(float(v)) for v in values)


def snapshot_of(graph: MeasuredGraph) -> GraphSnapshot:
    """Return the graph as a pose graph would hold it, starting from chained odometry.

    Edges between neighbouring ids are odometry, all others loops to be judged. Covariances stay as
    the file has them. Stamps are the ids, for the format has none.

    Raises:
        DataError: two neighbours have no edge between them.
    """
    row_of = {int(i): row for row, i in enumerate(graph.ids)}
    motions = np.tile(np.eye(4), (len(graph.ids), 1, 1))
    covariances = np.tile(np.eye(6), (len(graph.ids), 1, 1))
    linked = np.zeros(len(graph.ids), bool)
    loops: dict[LoopKey, GraphLoop] = {}
    for (i, j), T, covariance in zip(
        graph.edges.tolist(), graph.T_first_second, graph.covariances, strict=True
    ):
        if i > j:
            i, j, covariance, T = j, i, se3.invert_covariance(T, covariance), se3.inverse(T)
        if row_of[j] == row_of[i] + 1 and not linked[row_of[j]]:
            motions[row_of[j]], covariances[row_of[j]] = T, covariance
            linked[row_of[j]] = True
        else:
            constraint = LoopConstraint(i, j, i, j, T, covariance, method='g2o')
            loops[i, j] = GraphLoop(constraint, covariance, LoopState.HELD)
    if not linked[1:].all():
        row = int(np.nonzero(~linked[1:])[0][0]) + 1
        raise DataError(
            f'expected an odometry edge between {graph.ids[row - 1]} and {graph.ids[row]}, '
            'found none; neighbouring ids must be linked'
        )
    T_odom_base = np.empty_like(motions)
    T_odom_base[0] = np.eye(4) if graph.T_world_body is None else graph.T_world_body[0]
    for row in range(1, len(motions)):
        T_odom_base[row] = T_odom_base[row - 1] @ motions[row]
    return GraphSnapshot(
        graph.ids,
        graph.ids,
        T_odom_base,
        T_odom_base,
        motions,
        covariances,
        loops=tuple(loops.values()),
    )


def measured_graph(snapshot: GraphSnapshot) -> MeasuredGraph:
    """Return what a .g2o file can hold of a pose graph: estimates, odometry and loops in use."""
    loops = [loop for loop in snapshot.loops if loop.state in IN_GRAPH]
    links = [(int(a), int(b)) for a, b in zip(snapshot.ids[:-1], snapshot.ids[1:], strict=True)]
    return MeasuredGraph(
        snapshot.ids,
        snapshot.T_map_base,
        np.array([*links, *(loop.key for loop in loops)], np.int64).reshape(-1, 2),
        np.array([*snapshot.motions[1:], *(loop.T_match_query for loop in loops)]).reshape(
            -1, 4, 4
        ),
        np.array([*snapshot.motion_covariances[1:], *(loop.covariance for loop in loops)]).reshape(
            -1, 6, 6
        ),
    )
