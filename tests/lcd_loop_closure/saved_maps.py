"""Make small maps for tests."""

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.compact_cloud import compact
from lcd_loop_closure.gnss import GnssDatum, GnssFactor
from lcd_loop_closure.graph_arrays import arrays_of
from lcd_loop_closure.graph_snapshot import GraphLoop, GraphSnapshot, LoopState
from lcd_loop_closure.loop import LoopConstraint, LoopStatus
from lcd_loop_closure.map_store import Descriptor, SavedMap


def made_up_map(count: int = 7, seed: int = 0, points: int = 60) -> SavedMap:
    """Return a map with everything that a map can hold: also what is unknown, by hand, or empty."""
    random = np.random.default_rng(seed)

    def poses() -> np.ndarray:
        return np.array([se3.exp(random.normal(size=6)) for _ in range(count)]).reshape(-1, 4, 4)

    def covariance(size: int = 6) -> np.ndarray:
        root = random.normal(size=(size, size))
        return root @ root.T + 0.1 * np.eye(size)

    loops: tuple[GraphLoop, ...] = ()
    gnss: tuple[GnssFactor, ...] = ()
    if count > 5:
        seen = LoopConstraint(
            0, 5, 10, 510, se3.exp(random.normal(size=6)), covariance(), 0.2, 0.9, 0.1, 800, 0.7,
            method='scan_context+bev+gicp', reason='gute Übereinstimmung',
        )  # fmt: skip
        unknown = LoopConstraint(
            1, 5, 110, 510, method='radius', status=LoopStatus.REJECTED_BY_HAND, reason='by hand'
        )
        loops = (
            GraphLoop(seen, covariance(), LoopState.CONFIRMED, 3),
            GraphLoop(unknown, covariance(), LoopState.UNUSED, 4),
        )
        gnss = (GnssFactor(2, random.normal(size=3), covariance(3), random.normal(size=3)),)
    graph = GraphSnapshot(
        ids=np.arange(count),
        stamps_ns=10 + 100 * np.arange(count),
        T_odom_base=poses(),
        T_map_base=poses(),
        motions=poses(),
        motion_covariances=np.array([covariance() for _ in range(count)]).reshape(-1, 6, 6),
        broken_links=(3,) if count > 3 else (),
        loops=loops,
        arrivals=5,
        gnss=gnss,
        gnss_datum=GnssDatum(49.0, 8.4, 110.0) if gnss else None,
        T_enu_map=se3.exp(random.normal(size=6)) if gnss else None,
    )
    clouds, descriptors = [], []
    for k in range(count):
        xyz = random.normal(size=(points if k != 2 else 0, 3)).astype(np.float32) * 20
        intensity = random.uniform(0, 1, len(xyz)).astype(np.float32) if k % 2 else None
        clouds.append(compact(PointCloud(xyz, intensity)))
        values = random.normal(size=12).astype(np.float32)
        descriptors.append(None if k == 4 else Descriptor('scan_context', values))
    return SavedMap(graph, tuple(clouds), tuple(descriptors))


def same_map(a: SavedMap, b: SavedMap) -> bool:
    """Compare two maps, array by array."""
    mine, others = arrays_of(a.graph), arrays_of(b.graph)
    if mine.keys() != others.keys():
        return False
    for name, values in mine.items():
        equal_nan = values.dtype.kind == 'f'
        if not np.array_equal(values, others[name], equal_nan=equal_nan):
            return False
    for x, y in zip(a.clouds, b.clouds, strict=True):
        if x.step_m != y.step_m or not np.array_equal(x.steps, y.steps):
            return False
        if (x.intensity is None) != (y.intensity is None):
            return False
        if x.intensity is not None and not np.array_equal(x.intensity, y.intensity):
            return False
    for d, e in zip(a.descriptors, b.descriptors, strict=True):
        if (d is None) != (e is None):
            return False
        both = d is not None and e is not None
        if both and (d.method != e.method or not np.array_equal(d.values, e.values)):
            return False
    return True
