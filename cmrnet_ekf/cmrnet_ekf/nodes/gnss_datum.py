"""Turn satellite fixes into positions in the map."""

import numpy as np

from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_loop_closure.gnss import GnssDatum, GnssFix


@config
class GnssDatumConfig:
    """Where world_frame lies on the Earth; zeros: its origin is the first fix."""

    latitude: float = setting(0.0, 'of its origin, WGS 84', unit='deg', low=-90.0, high=90.0)
    longitude: float = setting(0.0, 'of its origin, WGS 84', unit='deg', low=-180.0, high=180.0)
    altitude: float = setting(0.0, 'of its origin, above the ellipsoid', unit='m')
    yaw: float = setting(
        0.0, 'of its x axis, from east to north', unit='deg', low=-360.0, high=360.0
    )


class MapDatum:
    """Answer where a fix lies in the map."""

    def __init__(self, settings: GnssDatumConfig) -> None:
        values = (settings.latitude, settings.longitude, settings.altitude, settings.yaw)
        if not np.isfinite(values).all():
            raise ConfigError(f'datum must be finite, got {values}')
        self.datum: GnssDatum | None = None
        if any(values[:3]):
            self.datum = GnssDatum(*values[:3])
        self._R_map_enu = se3.rotation_z(-np.radians(settings.yaw))[:3, :3]

    def in_map(self, fix: GnssFix, covariance_enu: se3.Array) -> tuple[se3.Array, se3.Array]:
        """Return a fix's position [3] and covariance [3 x 3] in map axes."""
        where = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
        if self.datum is None:
            self.datum = GnssDatum(*where)
        R = self._R_map_enu
        return R @ self.datum.enu(*where), R @ covariance_enu @ R.T
