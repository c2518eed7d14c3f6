"""Tie a map to the Earth with satellite fixes."""

from dataclasses import dataclass

from lcd_common import se3


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
class GnssAlignment:
    """Where the map lies: the datum of the ENU frame on WGS 84, and T_enu_map."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    T_enu_map: se3.Array
