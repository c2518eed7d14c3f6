"""Receive navigation satellites between houses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.simulation.lidar import Caster
from bags.street.mesh import Label
from lcd_common import se3
from lcd_common.settings import config, setting

_EQUATOR_M, _SQUARED_ECCENTRICITY = 6378137.0, 6.69437999014e-3  # WGS-84
_MASK_RAD = np.radians(10.0)
_BLOCKING = np.array([Label.BUILDING, Label.TERRAIN])


@config
class ReceiverConfig:
    """A satellite receiver in a car."""

    rate: float = setting(1.0, 'fixes per second', unit='Hz', low=0.01, high=100.0)
    satellites: int = setting(12, 'above ten degrees in an open field', low=4, high=60)
    range_noise: float = setting(1.2, 'of the range to one satellite', unit='m', low=0.0)
    multipath: float = setting(
        4.0, 'more of it when all other satellites are hidden, which come by reflections', unit='m',
        low=0.0,
    )  # fmt: skip
    memory: float = setting(15.0, 'time after which errors are others', unit='s', low=0.0)
    largest_dilution: float = setting(8.0, 'of precision (PDOP) with which a fix is given', low=1.0)
    latitude: float = setting(49.0, 'of the origin of the world', unit='deg', low=-80.0, high=80.0)
    longitude: float = setting(8.4, 'of the origin', unit='deg', low=-180.0, high=180.0)


@dataclass(frozen=True)
class Reception:
    """What a receiver knows at times [N].

    Attributes:
        visible: [N] number of satellites in sight.
        has_fix: [N] whether they suffice.
        covariance_enu: [N x 3 x 3] of the position, metres; NaN without a fix.
        error_enu: [N x 3] drawn from it, metres.
    """

    visible: NDArray[np.intp]
    has_fix: NDArray[np.bool_]
    covariance_enu: se3.Array
    error_enu: se3.Array


def sky(settings: ReceiverConfig, seed: int) -> se3.Array:
    """Return unit vectors [S x 3] to satellites, spread over the sky above the mask."""
    rng = np.random.default_rng([seed, 41])
    sine = rng.uniform(np.sin(_MASK_RAD), 1.0, settings.satellites)
    azimuth = rng.uniform(0.0, 2.0 * np.pi, settings.satellites)
    level = np.sqrt(1.0 - sine**2)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), sine])


def receive(
    antenna_xyz: se3.Array, caster: Caster, settings: ReceiverConfig, seed: int
) -> Reception:
    """Return what a receiver knows at positions [N x 3], one fix's period after another.

    A satellite counts when no house stands before it; leaves are looked through. Fewer of them
    dilute the precision, and the more are hidden, the larger is the error of each range. Errors
    are correlated in time (Gauss-Markov), as those of real receivers are.
    """
    to_satellite = sky(settings, seed)
    count, satellites = len(antenna_xyz), len(to_satellite)
    hits = caster.cast(
        np.repeat(antenna_xyz, satellites, axis=0), np.tile(to_satellite, (count, 1))
    )
    hidden = np.isfinite(hits.range_m) & np.isin(hits.label, _BLOCKING)
    seen = ~hidden.reshape(count, satellites)
    G = np.column_stack([-to_satellite, np.ones(satellites)])
    information = np.einsum('ns,si,sj->nij', seen.astype(np.float64), G, G)
    visible = seen.sum(axis=1)
    covariance = np.full((count, 3, 3), np.nan)
    has_fix = visible >= 4
    solved = np.linalg.pinv(information[has_fix], hermitian=True)
    full_rank = np.linalg.matrix_rank(information[has_fix], tol=1e-3, hermitian=True) == 4
    dilution = np.sqrt(np.trace(solved[:, :3, :3], axis1=1, axis2=2))
    usable = full_rank & (dilution <= settings.largest_dilution)
    has_fix[np.flatnonzero(has_fix)[~usable]] = False
    share_hidden = 1.0 - visible[has_fix] / satellites
    sigma = np.hypot(settings.range_noise, settings.multipath * share_hidden)
    covariance[has_fix] = solved[usable][:, :3, :3] * sigma[:, None, None] ** 2
    error = np.full((count, 3), np.nan)
    root = np.linalg.cholesky(covariance[has_fix] + 1e-12 * np.eye(3))
    error[has_fix] = np.einsum('nij,nj->ni', root, _remembered(count, settings, seed)[has_fix])
    return Reception(visible, has_fix, covariance, error)


def _remembered(count: int, settings: ReceiverConfig, seed: int) -> se3.Array:
    """Return a Gauss-Markov sequence [N x 3] of unit variance."""
    drawn = np.random.default_rng([seed, 42]).normal(size=(count, 3))
    keep = float(np.exp(-1.0 / (settings.rate * settings.memory))) if settings.memory else 0.0
    for k in range(1, count):
        drawn[k] = keep * drawn[k - 1] + np.sqrt(1.0 - keep**2) * drawn[k]
    return drawn


def geodetic(xyz: se3.Array, settings: ReceiverConfig) -> tuple[float, float, float]:
    """Return latitude, longitude (degrees) and altitude of an east-north-up position [3].

    By the radii of curvature at the origin: millimetres off over the kilometre of a town.
    """
    east, north, up = (float(v) for v in xyz)
    sine = np.sin(np.radians(settings.latitude))
    normal = _EQUATOR_M / np.sqrt(1.0 - _SQUARED_ECCENTRICITY * sine**2)
    meridian = normal * (1.0 - _SQUARED_ECCENTRICITY) / (1.0 - _SQUARED_ECCENTRICITY * sine**2)
    level = normal * np.cos(np.radians(settings.latitude))
    return (
        settings.latitude + float(np.degrees(north / meridian)),
        settings.longitude + float(np.degrees(east / level)),
        up,
    )
