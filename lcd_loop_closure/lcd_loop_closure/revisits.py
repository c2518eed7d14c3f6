"""Count where a trajectory returns to places that it has seen (thesis section 3.3.1)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common import se3
from lcd_common.settings import config, setting


@config
class RevisitConfig:
    """What counts as a revisit; the defaults are the thesis's."""

    distance: float = setting(4.0, 'largest distance of two scans of one place', unit='m', low=0.0)
    excluded_scans: int = setting(50, 'scans just before one that do not count', low=0)
    first_scan: int = setting(100, 'first scan that is tested', low=0)
    reverse_angle: float = setting(
        0.7854,
        'a pass turned by more against the first one is reverse',
        unit='rad',
        low=0.0,
        high=3.1416,
    )


@dataclass(frozen=True)
class RevisitStatistics:
    """The thesis's Table 3.1 for one trajectory.

    Attributes:
        scans: poses in the file.
        loops: scans with at least one earlier scan of the same place.
        pairs: pairs of scans of the same place.
        reverse_share: share of the pairs that were passed in another direction; None without pairs.
        length_m: length of the path.
    """

    scans: int
    loops: int
    pairs: int
    reverse_share: float | None
    length_m: float


def count_revisits(
    T_world_body: se3.Array, settings: RevisitConfig | None = None
) -> RevisitStatistics:
    """Count the revisits of a trajectory [N x 4 x 4].

    Scan i, from `first_scan` on, revisits scan j when j <= i - excluded_scans and both lie within
    `distance`, in three dimensions (LCDNet's inference_yaw_general.py).
    """
    settings = settings or RevisitConfig()
    loops = pairs = reverse = 0
    R = T_world_body[:, :3, :3]
    for i, partners in _partners(T_world_body[:, :3, 3], settings):
        if not len(partners):
            continue
        loops += 1
        pairs += len(partners)
        # The angle of the rotation between both holds for camera axes as for vehicle axes.
        cosine = np.clip((np.einsum('jab,ab->j', R[partners], R[i]) - 1.0) / 2.0, -1.0, 1.0)
        reverse += int(np.count_nonzero(np.arccos(cosine) > settings.reverse_angle))
    steps = np.linalg.norm(np.diff(T_world_body[:, :3, 3], axis=0), axis=1)
    return RevisitStatistics(
        scans=len(T_world_body),
        loops=loops,
        pairs=pairs,
        reverse_share=reverse / pairs if pairs else None,
        length_m=float(steps.sum()),
    )


def true_loops(
    positions: NDArray[np.floating], settings: RevisitConfig | None = None
) -> list[NDArray[np.intp]]:
    """Return, for every position [N x 3], the earlier ones that it revisits, nearest first."""
    settings = settings or RevisitConfig()
    found = [np.empty(0, np.intp) for _ in range(len(positions))]
    for i, partners in _partners(positions, settings):
        away = np.linalg.norm(positions[partners] - positions[i], axis=1)
        found[i] = partners[np.argsort(away, kind='stable')]
    return found


def _partners(
    positions: NDArray[np.floating], settings: RevisitConfig
) -> Iterator[tuple[int, NDArray[np.intp]]]:
    tree = cKDTree(positions) if len(positions) else None
    for i in range(settings.first_scan, len(positions)):
        assert tree is not None
        near = np.array(sorted(tree.query_ball_point(positions[i], settings.distance)), np.intp)
        yield i, near[near <= i - settings.excluded_scans]
