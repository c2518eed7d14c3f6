"""Make pairs with an accurate pose where positions come from satellites: the Freiburg protocol."""

from collections.abc import Callable

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.baselines.icp import thinned
from lcd_loop_closure.evaluation.registration_pairs import RegistrationPairs
from lcd_loop_closure.revisits import RevisitConfig


@config
class IcpPairsConfig:
    """Thesis section 3.3.11; what it does not say is marked as ours."""

    radius: float = setting(10.0, 'largest distance of a pair', unit='m', low=0.1)
    excluded_scans: int = setting(100, 'scans before and after one that are left out', low=0)
    min_fitness: float = setting(0.6, 'share of points with a partner after ICP', low=0.0, high=1.0)
    max_rmse: float = setting(0.3, 'of these partners', unit='m', low=0.0)
    iterations: int = setting(1000, 'of ICP, at most', low=1)
    gate: float = setting(1.0, 'largest distance of partners (ours)', unit='m', low=0.05)
    levels: tuple[float, ...] = setting(
        (30.0, 90.0), 'headings between the three levels of difficulty (ours)', unit='deg'
    )
    voxel_size: float = setting(0.2, 'thinning of both clouds (ours)', unit='m', low=0.0)


def icp_pairs(
    T_world_base: se3.Array,
    cloud_of: Callable[[int], PointCloud],
    settings: IcpPairsConfig | None = None,
    *,
    count: int | None = None,
    seed: int = 0,
    progress: Callable[[], None] = lambda: None,
) -> RegistrationPairs:
    """Return pairs whose pose ICP confirms from the reference, as many of each direction.

    For each scan one earlier neighbour is drawn for each level of turn between the two.

    Args:
        T_world_base: [N x 4 x 4] reference poses.
        cloud_of: sweep of a scan, base frame.
        settings: of the protocol.
        count: stop after so many good pairs of each direction; None: try all.
        seed: of the draws.
        progress: called for each pair tried.
    """
    s = settings or IcpPairsConfig()
    match, query, level = drawn_pairs(T_world_base, s, seed)
    reverse = level == len(s.levels)
    rng = np.random.default_rng([seed, 43])
    wanted = len(match) if count is None else count
    found: dict[bool, list[tuple[int, int, se3.Array]]] = {False: [], True: []}
    clouds: dict[int, o3d.geometry.PointCloud] = {}
    for k in rng.permutation(len(match)):
        of_kind = found[bool(reverse[k])]
        if len(of_kind) < wanted:
            for scan in (int(match[k]), int(query[k])):
                if scan not in clouds:
                    clouds[scan] = thinned(cloud_of(scan), s.voxel_size)
            T = se3.inverse(T_world_base[match[k]]) @ T_world_base[query[k]]
            refined = _confirmed(clouds[int(match[k])], clouds[int(query[k])], T, s)
            if refined is not None:
                of_kind.append((int(match[k]), int(query[k]), refined))
        progress()
    # About as many of each direction, where both are there.
    least = min(len(found[False]), len(found[True]))
    kept = [one for of_kind in found.values() for one in of_kind[: least or None]]
    kept.sort(key=lambda one: (one[1], one[0]))
    T_match_query = np.array([T for _, _, T in kept]).reshape(-1, 4, 4)
    heading = np.abs(np.arctan2(T_match_query[:, 1, 0], T_match_query[:, 0, 0]))
    return RegistrationPairs(
        np.array([m for m, _, _ in kept], np.intp),
        np.array([q for _, q, _ in kept], np.intp),
        T_match_query,
        heading > np.radians(s.levels[-1]),
        len(match),
    )


def drawn_pairs(
    T_world_base: se3.Array, settings: IcpPairsConfig, seed: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return match, query and level [P]: a neighbour for each scan and level that has one."""
    from lcd_loop_closure.evaluation.registration_pairs import Band, choose_pairs

    s = settings
    near = choose_pairs(
        T_world_base,
        Band(0.0, s.radius),
        RevisitConfig(first_scan=0, excluded_scans=s.excluded_scans + 1),
    )
    T = near.T_match_query
    turn = np.degrees(np.abs(np.arctan2(T[:, 1, 0], T[:, 0, 0])))
    level = np.searchsorted(np.array(s.levels), turn, side='right')
    order = np.random.default_rng([seed, 41]).permutation(len(turn))
    _, first = np.unique(near.query[order] * (len(s.levels) + 1) + level[order], return_index=True)
    kept = np.sort(order[first])
    return near.match[kept], near.query[kept], level[kept]


def _confirmed(
    match: o3d.geometry.PointCloud,
    query: o3d.geometry.PointCloud,
    T_match_query: se3.Array,
    s: IcpPairsConfig,
) -> se3.Array | None:
    registration = o3d.pipelines.registration
    result = registration.registration_icp(
        query,
        match,
        s.gate,
        T_match_query,
        registration.TransformationEstimationPointToPoint(),
        registration.ICPConvergenceCriteria(max_iteration=s.iterations),
    )
    good = result.fitness >= s.min_fitness and result.inlier_rmse <= s.max_rmse
    return np.asarray(result.transformation) if good else None
