"""Turn a graph's snapshot into named arrays and back, for a file without pickle."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.gnss import GnssDatum, GnssFactor
from lcd_loop_closure.graph_snapshot import GraphLoop, GraphSnapshot, LoopState
from lcd_loop_closure.loop import LoopConstraint, LoopStatus

Arrays = dict[str, NDArray[Any]]
_NUMBERS = ('descriptor_distance', 'fitness', 'rmse_m', 'overlap', 'false_match_probability')
_INTEGERS = ('match_id', 'query_id', 'match_stamp_ns', 'query_stamp_ns', 'inliers')
_POSES = ('T_odom_base', 'T_map_base', 'motions')


def arrays_of(graph: GraphSnapshot) -> Arrays:
    """Return all of a snapshot; None among numbers and matrices becomes NaN."""
    out: Arrays = {name: getattr(graph, name) for name in ('ids', 'stamps_ns', *_POSES)}
    out['motion_covariances'] = graph.motion_covariances
    out['broken_links'] = np.array(graph.broken_links, np.int64)
    out['arrivals'] = np.array(graph.arrivals, np.int64)
    out.update(_loop_arrays(graph.loops))
    out['gnss_keyframe_id'] = np.array([f.keyframe_id for f in graph.gnss], np.int64)
    for name, shape in (
        ('position_enu', (3,)),
        ('covariance_enu', (3, 3)),
        ('position_base', (3,)),
    ):
        values = [getattr(factor, name) for factor in graph.gnss]
        out[f'gnss_{name}'] = np.array(values, np.float64).reshape(-1, *shape)
    datum = graph.gnss_datum
    out['gnss_datum'] = np.array(
        [] if datum is None else [datum.latitude_deg, datum.longitude_deg, datum.altitude_m]
    )
    out['T_enu_map'] = np.full((4, 4), np.nan) if graph.T_enu_map is None else graph.T_enu_map
    return out


def snapshot_from(arrays: Mapping[str, NDArray[Any]]) -> GraphSnapshot:
    """Return the snapshot that `arrays_of` took apart.

    Raises:
        DataError: an array is missing, has another shape, or holds what a graph cannot.
    """
    ids = _integers(arrays, 'ids')
    count = len(ids)
    if np.any(np.diff(ids) <= 0):
        raise DataError('expected keyframe ids that increase')
    poses = {name: _poses(arrays, name, count) for name in _POSES}
    covariances = _reals(arrays, 'motion_covariances', (count, 6, 6))
    loops = _loops(arrays, set(ids.tolist()))
    gnss = _gnss(arrays)
    if not {factor.keyframe_id for factor in gnss} <= set(ids.tolist()):
        raise DataError('a satellite fix is tied to a keyframe that is not there')
    datum, T_enu_map = _reals(arrays, 'gnss_datum', None), arrays['T_enu_map']
    return GraphSnapshot(
        ids=ids,
        stamps_ns=_integers(arrays, 'stamps_ns', count),
        motion_covariances=covariances,
        broken_links=tuple(_integers(arrays, 'broken_links').tolist()),
        loops=loops,
        arrivals=int(arrays['arrivals']),
        gnss=gnss,
        gnss_datum=GnssDatum(*datum.tolist()) if len(datum) else None,
        T_enu_map=None if np.isnan(T_enu_map).any() else T_enu_map,
        **poses,
    )


def _loop_arrays(loops: Sequence[GraphLoop]) -> Arrays:
    constraints = [loop.constraint for loop in loops]
    out: Arrays = {
        f'loop_{name}': np.array([getattr(c, name) for c in constraints], np.int64)
        for name in _INTEGERS
    }
    for name in _NUMBERS:
        values = [getattr(c, name) for c in constraints]
        out[f'loop_{name}'] = np.array([math.nan if v is None else v for v in values], np.float64)
    out['loop_transform'] = _stacked([c.T_match_query for c in constraints], 4)
    out['loop_measured_covariance'] = _stacked([c.covariance for c in constraints], 6)
    out['loop_covariance'] = _stacked([loop.covariance for loop in loops], 6)
    out['loop_state'] = np.array([int(loop.state) for loop in loops], np.int64)
    out['loop_serial'] = np.array([loop.serial for loop in loops], np.int64)
    out['loop_status'] = np.array([int(c.status) for c in constraints], np.int64)
    out['loop_method'] = np.array([c.method for c in constraints], np.str_)
    out['loop_reason'] = np.array([c.reason for c in constraints], np.str_)
    return out


def _loops(arrays: Mapping[str, NDArray[Any]], known: set[int]) -> tuple[GraphLoop, ...]:
    integers = {name: _integers(arrays, f'loop_{name}') for name in _INTEGERS}
    count = len(integers['match_id'])
    numbers = {name: arrays[f'loop_{name}'].reshape(count) for name in _NUMBERS}
    covariances = _reals(arrays, 'loop_covariance', (count, 6, 6))
    loops = []
    for k in range(count):
        constraint = LoopConstraint(
            match_id=int(integers['match_id'][k]),
            query_id=int(integers['query_id'][k]),
            match_stamp_ns=int(integers['match_stamp_ns'][k]),
            query_stamp_ns=int(integers['query_stamp_ns'][k]),
            inliers=int(integers['inliers'][k]),
            descriptor_distance=_or_none(numbers['descriptor_distance'][k]),
            fitness=_or_none(numbers['fitness'][k]),
            rmse_m=_or_none(numbers['rmse_m'][k]),
            overlap=_or_none(numbers['overlap'][k]),
            false_match_probability=_or_none(numbers['false_match_probability'][k]),
            T_match_query=_matrix(arrays['loop_transform'][k]),
            covariance=_matrix(arrays['loop_measured_covariance'][k]),
            method=str(arrays['loop_method'][k]),
            status=LoopStatus(int(arrays['loop_status'][k])),
            reason=str(arrays['loop_reason'][k]),
        )
        state = LoopState(int(arrays['loop_state'][k]))
        loop = GraphLoop(constraint, covariances[k], state, int(arrays['loop_serial'][k]))
        if not set(loop.key) <= known:
            raise DataError(f'the loop {loop.key} is between keyframes that are not there')
        if constraint.T_match_query is None and state is not LoopState.UNUSED:
            raise DataError(f'the loop {loop.key} is in use without a transform')
        loops.append(loop)
    return tuple(loops)


def _gnss(arrays: Mapping[str, NDArray[Any]]) -> tuple[GnssFactor, ...]:
    ids = _integers(arrays, 'gnss_keyframe_id')
    positions = _reals(arrays, 'gnss_position_enu', (len(ids), 3))
    covariances = _reals(arrays, 'gnss_covariance_enu', (len(ids), 3, 3))
    levers = _reals(arrays, 'gnss_position_base', (len(ids), 3))
    rows = zip(ids.tolist(), positions, covariances, levers, strict=True)
    return tuple(GnssFactor(*row) for row in rows)


def _integers(
    arrays: Mapping[str, NDArray[Any]], name: str, count: int | None = None
) -> NDArray[np.int64]:
    values = arrays[name]
    if values.ndim != 1 or values.dtype.kind not in 'iu' or count not in (None, len(values)):
        raise DataError(
            f'{name}: expected {"as many" if count is None else count} integers, '
            f'got {values.shape} {values.dtype}'
        )
    return values.astype(np.int64)


def _reals(
    arrays: Mapping[str, NDArray[Any]], name: str, shape: tuple[int, ...] | None
) -> se3.Array:
    values = arrays[name]
    if values.dtype.kind != 'f' or shape not in (None, values.shape):
        raise DataError(f'{name}: expected real numbers {shape}, got {values.shape} {values.dtype}')
    if not np.isfinite(values).all():
        raise DataError(f'{name}: a number is not finite')
    return values.astype(np.float64)


def _poses(arrays: Mapping[str, NDArray[Any]], name: str, count: int) -> se3.Array:
    T = _reals(arrays, name, (count, 4, 4))
    R = T[:, :3, :3]
    error = R @ np.swapaxes(R, 1, 2) - np.eye(3)
    if count and (np.abs(error).max() > 1e-6 or np.any(T[:, 3] != [0, 0, 0, 1])):
        raise DataError(f'{name}: a matrix is no rigid transform')
    return T


def _stacked(matrices: Sequence[se3.Array | None], size: int) -> se3.Array:
    unknown = np.full((size, size), np.nan)
    rows = [unknown if m is None else m for m in matrices]
    return np.array(rows, np.float64).reshape(-1, size, size)


def _matrix(values: se3.Array) -> se3.Array | None:
    return values if np.isfinite(values).all() else None


def _or_none(value: np.float64) -> float | None:
    return None if np.isnan(value) else float(value)
