"""Tie a map to the Earth with satellite fixes.

The first fix is the datum of a local east-north-up frame. Where the map lies in it is found once
the drive has a baseline: a yaw and a translation, for the map is level within the vehicle's tilt.
From then on T_enu_map stays as it is and the fixes act on the keyframes; the graph gives its first
pose the freedom that the alignment's error needs.
"""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.settings import config, setting

_A = 6378137.0
_E2 = 6.69437999014e-3
# Width of the Cauchy kernel in sigmas: what reflected signals may do.
_KERNEL = 2.0
_FEWEST = 5


@config
class GnssConfig:
    """How satellite fixes are used."""

    baseline: float = setting(
        30.0, 'spread of the fixes (root mean square) before they are used', unit='m', low=1.0
    )
    minimum_sigma: float = setting(
        0.5, 'no fix is believed to be better than this', unit='m', low=1e-3
    )
    maximum_sigma: float = setting(20.0, 'fixes worse than this are not used', unit='m', low=0.1)


@dataclass(frozen=True)
class GnssFix:
    """A position on WGS 84; covariance_enu is 3x3 in m^2, east north up (NavSatFix's order)."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_enu: se3.Array


@dataclass(frozen=True)
class GnssFactor:
    """A fix in the local east-north-up frame, of a point given in a keyframe's body frame."""

    keyframe_id: int
    position_enu: se3.Array
    covariance_enu: se3.Array
    position_base: se3.Array


@dataclass(frozen=True)
class GnssDatum:
    """Origin of the east-north-up frame on WGS 84."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def enu(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> se3.Array:
        """Return a position [3] east, north and up of the datum, metres."""
        ecef = _ecef(latitude_deg, longitude_deg, altitude_m)
        origin = _ecef(self.latitude_deg, self.longitude_deg, self.altitude_m)
        latitude, longitude = np.radians([self.latitude_deg, self.longitude_deg])
        sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
        sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
        R_enu_ecef = np.array(
            [
                [-sin_lon, cos_lon, 0.0],
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
            ]
        )
        return R_enu_ecef @ (ecef - origin)


class GnssTie:
    """Collect fixes and find where the map lies among them."""

    def __init__(self, settings: GnssConfig) -> None:
        self.settings = settings
        self.datum: GnssDatum | None = None
        self.T_enu_map: se3.Array | None = None
        self.factors: list[GnssFactor] = []

    def add(self, fix: GnssFix, keyframe_id: int, position_base: se3.Array) -> GnssFactor:
        """Tie a keyframe to a fix of a point given in its body frame; the first sets the datum.

        Raises:
            DataError: the fix cannot be used; the text says why.
        """
        covariance = usable_covariance(fix, self.settings)
        where = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
        if self.datum is None:
            self.datum = GnssDatum(*where)
        factor = GnssFactor(keyframe_id, self.datum.enu(*where), covariance, position_base)
        self.factors.append(factor)
        return factor

    def align(self, T_map_base_of: Callable[[int], se3.Array]) -> bool:
        """Find T_enu_map from the fixes so far; True when this call found it."""
        if self.T_enu_map is not None or len(self.factors) < _FEWEST:
            return False
        positions_map = np.array(
            [
                se3.transform_points(T_map_base_of(f.keyframe_id), f.position_base[None])[0]
                for f in self.factors
            ]
        )
        positions_enu = np.array([f.position_enu for f in self.factors])
        self.T_enu_map = align(positions_map, positions_enu, self.settings)
        return self.T_enu_map is not None


def usable_covariance(fix: GnssFix, settings: GnssConfig) -> se3.Array:
    """Return the fix's covariance, not below the configured floor.

    Raises:
        DataError: a number is not finite, off the Earth, or the fix is too uncertain; the text says
            which.
    """
    numbers = np.array([fix.latitude_deg, fix.longitude_deg, fix.altitude_m])
    if not np.isfinite(numbers).all() or abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        raise DataError(f'expected a position on the Earth, got {numbers.tolist()}; fix dropped')
    covariance = np.asarray(fix.covariance_enu, dtype=np.float64)
    if covariance.shape != (3, 3) or not np.isfinite(covariance).all():
        raise DataError('expected a finite 3 x 3 position covariance; fix dropped')
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if values[-1] > settings.maximum_sigma**2:
        raise DataError(
            f'a fix with a sigma of {np.sqrt(values[-1]):.1f} m is worse than the limit of '
            f'{settings.maximum_sigma:g} m; fix dropped'
        )
    values = np.maximum(values, settings.minimum_sigma**2)
    return vectors @ np.diag(values) @ vectors.T


def align(
    positions_map: se3.Array, positions_enu: se3.Array, settings: GnssConfig
) -> se3.Array | None:
    """Return T_enu_map (yaw and translation) from paired positions [N x 3].

    None where the baseline is too short for it.

    Least squares in closed form, reweighted by a Cauchy kernel so that a few reflected fixes do not
    turn the map.
    """
    if len(positions_map) < 3:
        return None
    weights = np.ones(len(positions_map))
    T = np.eye(4)
    for _ in range(20):
        w = weights / weights.sum()
        centre_map, centre_enu = w @ positions_map, w @ positions_enu
        a = (positions_map - centre_map)[:, :2]
        b = (positions_enu - centre_enu)[:, :2]
        spread = min(w @ (a**2).sum(axis=1), w @ (b**2).sum(axis=1))
        if spread < settings.baseline**2:
            return None
        sine = w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        cosine = w @ (a * b).sum(axis=1)
        T = se3.rotation_z(float(np.arctan2(sine, cosine)))
        T[:3, 3] = centre_enu - T[:3, :3] @ centre_map
        off = np.linalg.norm(positions_enu - se3.transform_points(T, positions_map), axis=1)
        scale = max(float(np.median(off)) * 1.5, settings.minimum_sigma)
        weights = 1.0 / (1.0 + (off / scale) ** 2)
    return T


def gnss_factor(factor: GnssFactor, T_enu_map: se3.Array, key: int) -> gtsam.GPSFactorArm:
    """Return GTSAM's factor on a keyframe's pose, with lever arm and a Cauchy kernel."""
    R_map_enu = T_enu_map[:3, :3].T
    position_map = R_map_enu @ (factor.position_enu - T_enu_map[:3, 3])
    covariance = R_map_enu @ factor.covariance_enu @ R_map_enu.T
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL),
        gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T)),
    )
    return gtsam.GPSFactorArm(key, position_map, factor.position_base, noise)


def _ecef(latitude_deg: float, longitude_deg: float, altitude_m: float) -> se3.Array:
    latitude, longitude = np.radians([latitude_deg, longitude_deg])
    normal = _A / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
    return np.array(
        [
            (normal + altitude_m) * np.cos(latitude) * np.cos(longitude),
            (normal + altitude_m) * np.cos(latitude) * np.sin(longitude),
            (normal * (1.0 - _E2) + altitude_m) * np.sin(latitude),
        ]
    )
