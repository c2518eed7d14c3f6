"""Sweeps of a simulated street, reduced as keyframes are, with their exact poses."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from bags.street.drive import T_BASE_LIDAR, StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud


@dataclass(frozen=True)
class StreetView:
    """A sweep in the base frame, what a keyframe keeps of it, and where it was taken."""

    cloud: PointCloud
    reduced: PointCloud
    T_world_base: se3.Array


@cache
def street(seed: int = 0) -> StreetDrive:
    """The drive around two blocks: about a minute, one revisit the same way, one in reverse."""
    return StreetDrive('loop', StreetConfig(seed=seed), LidarConfig(point_time=False, columns=720))


@cache
def view(index: int, seed: int = 0) -> StreetView:
    """Cast sweep `index`."""
    drive = street(seed)
    cloud = drive.scan(index).cloud.transformed(T_BASE_LIDAR)
    T_world_base = drive.truth().T_world_body[index]
    return StreetView(cloud, reduce_cloud(cloud, ReductionConfig()), T_world_base)


def turned(seen: StreetView, yaw: float) -> StreetView:
    """The same sweep as a vehicle with another heading would have taken it."""
    T_base_turned = se3.rotation_z(yaw)
    T_turned_base = se3.inverse(T_base_turned)
    return StreetView(
        seen.cloud.transformed(T_turned_base),
        seen.reduced.transformed(T_turned_base),
        seen.T_world_base @ T_base_turned,
    )


def pairs_apart(low_m: float, high_m: float, seed: int = 0) -> list[tuple[int, int]]:
    """Sweeps at least ten seconds apart in time and within an interval of distance."""
    positions = street(seed).truth().positions
    away = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    first, second = np.nonzero((away >= low_m) & (away < high_m))
    return [(int(i), int(j)) for i, j in zip(first, second, strict=True) if j >= i + 100]


def relative(match: StreetView, query: StreetView) -> se3.Array:
    """True T_match_query."""
    return se3.inverse(match.T_world_base) @ query.T_world_base
