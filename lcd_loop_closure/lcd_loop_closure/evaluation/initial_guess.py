"""How much a guess helps ICP: its time and RMSE with and without (thesis section 3.3.7)."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.baselines.registration import CloudRegistration
from lcd_loop_closure.evaluation.registration_pairs import RegistrationPairs

_GATE_M = 2.0
_ITERATIONS = 100


@dataclass(frozen=True)
class GuessComparison:
    """Means over pairs: point-to-point ICP of whole sweeps from the identity and from a guess.

    Attributes:
        pairs: compared.
        ms, guided_ms: time; with a guess that of making it from the sweeps included.
        rmse_m, guided_rmse_m: root mean square distance of where ICP puts the query's points from
            where they truly are, over its points.
    """

    pairs: int
    ms: float
    guided_ms: float
    rmse_m: float
    guided_rmse_m: float

    def plain(self) -> dict[str, Any]:
        """Return the figures."""
        return dict(vars(self))


def compare_guess(
    registration: CloudRegistration,
    cloud_of: Callable[[int], PointCloud],
    pairs: RegistrationPairs,
    *,
    progress: Callable[[], None] = lambda: None,
) -> GuessComparison | None:
    """Run ICP over pairs from the identity and from a registration's answer; None without pairs.

    Where the registration has no answer ICP starts from the identity.
    """
    rows = []
    for k in range(len(pairs)):
        match, query = cloud_of(int(pairs.match[k])), cloud_of(int(pairs.query[k]))
        a, b = _open3d(match), _open3d(query)
        T_plain, seconds = _icp(a, b, np.eye(4))
        start = time.perf_counter()
        guess = registration.register(registration.prepare(match), registration.prepare(query))
        guessing = time.perf_counter() - start
        T_guided, refining = _icp(a, b, np.eye(4) if guess is None else guess)
        true = se3.transform_points(pairs.T_match_query[k], query.xyz.astype(np.float64))
        rows.append(
            (
                1e3 * seconds,
                1e3 * (guessing + refining),
                _rmse(T_plain, query, true),
                _rmse(T_guided, query, true),
            )
        )
        progress()
    if not rows:
        return None
    return GuessComparison(len(rows), *(float(v) for v in np.mean(rows, axis=0)))


def _icp(
    match: o3d.geometry.PointCloud, query: o3d.geometry.PointCloud, T_match_query: se3.Array
) -> tuple[se3.Array, float]:
    registration = o3d.pipelines.registration
    start = time.perf_counter()
    result = registration.registration_icp(
        query,
        match,
        _GATE_M,
        T_match_query,
        registration.TransformationEstimationPointToPoint(),
        registration.ICPConvergenceCriteria(max_iteration=_ITERATIONS),
    )
    return np.asarray(result.transformation), time.perf_counter() - start


def _open3d(cloud: PointCloud) -> o3d.geometry.PointCloud:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.xyz.astype(np.float64)))


def _rmse(T_match_query: se3.Array, query: PointCloud, true: NDArray[np.floating]) -> float:
    moved = se3.transform_points(T_match_query, query.xyz.astype(np.float64))
    return float(np.sqrt(np.mean(np.sum((moved - true) ** 2, axis=1))))
