"""Simulated sweeps with the lidar's exact poses, for the odometry's tests."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from bags.street import LidarConfig, Route, StreetConfig, StreetDrive, abrupt_u_turn
from bags.street.drive import T_BASE_LIDAR
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.lidar_odometry import LidarOdometry, OdometryConfig, OdometryEstimate


@dataclass(frozen=True)
class Sample:
    """A sweep and where the lidar was at its stamp."""

    stamp_ns: int
    cloud: PointCloud
    T_world_lidar: se3.Array


def corner() -> Route:
    """Start at speed, slow down, turn left, stop."""
    return Route(speed=9.0).through([(0, 0), (30, 0), (30, 24)])


def creep() -> Route:
    """Walking pace."""
    return Route(speed=1.5).through([(0, 0), (12, 0)])


ROUTES: dict[str, Callable[[], Route]] = {
    'corner': corner, 'creep': creep, 'u_turn': abrupt_u_turn
}  # fmt: skip


@cache
def drive(
    route: str, seed: int, indices: tuple[int, ...], timed: bool = False, columns: int = 720
) -> tuple[Sample, ...]:
    """Cast the given sweeps of a route; each is a snapshot, or taken while driving (`timed`)."""
    lidar = LidarConfig(columns=columns, point_time=timed)
    town = StreetDrive(ROUTES[route](), StreetConfig(seed=seed), lidar)
    poses = town.truth().T_world_body
    scans = [(town.scan(i), i) for i in indices]
    return tuple(Sample(s.stamp_ns, s.cloud, poses[i] @ T_BASE_LIDAR) for s, i in scans)


def follow(
    samples: Sequence[Sample], **settings: object
) -> tuple[LidarOdometry, list[OdometryEstimate]]:
    """Register all sweeps."""
    odometry = LidarOdometry(OdometryConfig(**settings))
    return odometry, [odometry.register(s.cloud, s.stamp_ns) for s in samples]


def motion_error(
    samples: Sequence[Sample], estimates: Sequence[OdometryEstimate], i: int, j: int
) -> se3.Array:
    """Return the twist from the estimated to the true motion between two sweeps."""
    estimated = se3.inverse(estimates[i].T_odom_lidar) @ estimates[j].T_odom_lidar
    true = se3.inverse(samples[i].T_world_lidar) @ samples[j].T_world_lidar
    return se3.log(se3.inverse(estimated) @ true)


def step_ratios(
    samples: Sequence[Sample], estimates: Sequence[OdometryEstimate], skip: int = 0
) -> se3.Array:
    """Return each step's normalised error squared over its expectation, 6."""
    ratios = []
    for j in range(1 + skip, len(samples)):
        error = motion_error(samples, estimates, j - 1, j)
        ratios.append(error @ np.linalg.solve(estimates[j].covariance, error) / 6.0)
    return np.array(ratios)


def span_ratios(
    samples: Sequence[Sample], estimates: Sequence[OdometryEstimate], metres: float, skip: int = 0
) -> se3.Array:
    """Return the same over a distance, with the growth of every step added up."""
    ratios = []
    for i in range(skip, len(samples)):
        covariance, T = np.zeros((6, 6)), np.eye(4)
        for j in range(i + 1, len(samples)):
            step = estimates[j].T_previous_this
            covariance = se3.compose_covariance(covariance, step, estimates[j].growth)
            T = T @ step
            if np.linalg.norm(T[:3, 3]) >= metres:
                error = motion_error(samples, estimates, i, j)
                ratios.append(error @ np.linalg.solve(covariance, error) / 6.0)
                break
    return np.array(ratios)
