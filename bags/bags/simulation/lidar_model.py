"""The spinning LiDARs that are simulated: where their beams point and how they err."""

from dataclasses import dataclass, replace

import numpy as np

from lcd_common import se3
from lcd_common.errors import ConfigError


@dataclass(frozen=True)
class LidarModel:
    """One spinning multi-beam LiDAR.

    Attributes:
        name: what users call it.
        elevation_rad: [B] of the beams, top first.
        columns: azimuth steps of a sweep; column 0 looks straight back, then clockwise.
        rate_hz: sweeps per second.
        min_range_m, max_range_m: nearest and farthest return.
        range_sigma_m: of the white noise of a range.
        beam_sigma_m: of the constant error that each beam has besides.
        angle_sigma_rad: of the constant errors of each beam's elevation and azimuth.
        elevation_bias_rad: how much higher all beams point than their calibration says.
        range_step_m: quantisation of ranges; 0 is none.
        divergence_rad: full angle of a beam; at edges one echo comes back, of the stronger surface
            or mixed from both.
        dual_return: whether the weaker surface's echo comes back as a point of its own, too.
        reach_m: at which half of the returns of a 10 % reflector at normal incidence are lost.
        dropout: share of the returns lost at random.
        has_intensity: whether points carry intensity.
        blocked_deg: (begin, end) azimuths counter-clockwise from straight ahead without returns.
    """

    name: str
    elevation_rad: se3.Array
    columns: int
    rate_hz: float = 10.0
    min_range_m: float = 0.9
    max_range_m: float = 120.0
    range_sigma_m: float = 0.02
    beam_sigma_m: float = 0.01
    angle_sigma_rad: float = 0.0005
    elevation_bias_rad: float = 0.0
    range_step_m: float = 0.002
    divergence_rad: float = 0.002
    dual_return: bool = False
    reach_m: float = 75.0
    dropout: float = 0.01
    has_intensity: bool = True
    blocked_deg: tuple[tuple[float, float], ...] = ()

    @property
    def rays(self) -> int:
        """Rays of a sweep."""
        return self.columns * len(self.elevation_rad)

    def azimuth_rad(self) -> se3.Array:
        """Return the azimuth [C] of each column, counter-clockwise from straight ahead."""
        return np.pi - 2.0 * np.pi * (np.arange(self.columns) + 0.5) / self.columns

    def directions(self) -> se3.Array:
        """Return unit vectors [C x B x 3] of all rays, lidar frame."""
        azimuth, elevation = self.azimuth_rad()[:, None], self.elevation_rad
        level = np.cos(elevation)
        return np.stack(
            [
                np.cos(azimuth) * level,
                np.sin(azimuth) * level,
                np.broadcast_to(np.sin(elevation), (self.columns, len(elevation))),
            ],
            axis=-1,
        )

    def column_time_s(self) -> se3.Array:
        """Return when each column [C] is measured, seconds after the sweep's stamp."""
        return np.arange(self.columns) / self.columns / self.rate_hz

    def blocked(self, *sectors_deg: tuple[float, float]) -> 'LidarModel':
        """Return the same sensor without returns in these azimuths (counter-clockwise, ahead 0)."""
        return replace(self, blocked_deg=sectors_deg)

    def open_columns(self) -> np.ndarray:
        """Return which columns [C] are not blocked."""
        azimuth = np.degrees(self.azimuth_rad())
        is_open = np.ones(self.columns, bool)
        for begin, end in self.blocked_deg:
            is_open &= (azimuth - begin) % 360.0 >= (end - begin) % 360.0
        return is_open


def _evenly(top_deg: float, bottom_deg: float, beams: int) -> se3.Array:
    return np.radians(np.linspace(top_deg, bottom_deg, beams))


# KITTI's HDL-64E: medians over the rings of 24 sweeps of sequence 00, degrees.
_HDL64 = np.radians(
    [
        2.64, 2.28, 2.04, 1.59, 1.31, 0.91, 0.64, 0.27, -0.07, -0.48, -0.78, -1.12, -1.50, -1.84,
        -2.16, -2.52, -2.80, -3.18, -3.44, -3.82, -4.10, -4.45, -4.79, -5.14, -5.54, -5.85, -6.15,
        -6.43, -6.80, -7.15, -7.39, -7.77, -8.37, -8.88, -9.33, -9.74, -10.20, -10.78, -11.28,
        -11.72, -12.17, -12.60, -13.14, -13.64, -14.22, -14.66, -15.15, -15.52, -16.15, -16.66,
        -17.24, -17.71, -18.19, -18.62, -19.05, -19.61, -20.11, -20.77, -21.23, -21.65, -22.09,
        -22.71, -23.17, -23.72,
    ]
)  # fmt: skip
_HDL32_LIKE = _evenly(10.67, -30.67, 32)

LIDARS: dict[str, LidarModel] = {
    model.name: model
    for model in (
        LidarModel('hdl64', _HDL64, 2083, max_range_m=80.0),
        # KITTI's own HDL-64E is known to be calibrated 0.2 degrees too low (Deschaud, IMLS-SLAM,
        # ICRA 2018), and the motion within its sweeps is undone imperfectly; the errors of angles
        # here stand for both, so large that KISS-ICP drifts about as much as it does on KITTI.
        # Its points miss the camera's edges by five pixels: not for a camera in a LiDAR map.
        LidarModel(
            'hdl64_kitti', _HDL64, 2083, max_range_m=80.0, angle_sigma_rad=0.003,
            elevation_bias_rad=0.0065,
        ),
        LidarModel(
            'os1_64', _evenly(22.5, -22.5, 64), 1024, range_sigma_m=0.015, beam_sigma_m=0.005,
            divergence_rad=0.003, reach_m=60.0, min_range_m=0.5,
        ),
        LidarModel(
            'vlp16', _evenly(15.0, -15.0, 16), 1800, range_sigma_m=0.015, beam_sigma_m=0.005,
            divergence_rad=0.003, reach_m=65.0, max_range_m=100.0, min_range_m=0.5,
        ),
        LidarModel(
            'beams32', _HDL32_LIKE, 1800, beam_sigma_m=0.005, divergence_rad=0.003, reach_m=60.0,
            max_range_m=100.0, min_range_m=0.7,
        ),
        # MulRan's OS1-64 does not see 70 degrees to the rear.
        LidarModel(
            'os1_64_mulran', _evenly(22.5, -22.5, 64), 1024, range_sigma_m=0.015,
            beam_sigma_m=0.005, divergence_rad=0.003, reach_m=60.0, min_range_m=0.5,
            blocked_deg=((145.0, 215.0),),
        ),
    )
}  # fmt: skip


def lidar_model(name: str) -> LidarModel:
    """Return the LiDAR of a name.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in LIDARS:
        raise ConfigError(f'a lidar is one of {", ".join(LIDARS)}, got {name!r}')
    return LIDARS[name]
