"""Drive along a path: a smooth motion in time, on the ground of its town."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from bags.simulation.itinerary import Itinerary, JourneyConfig, itinerary
from bags.simulation.path import Path, lay_path
from bags.simulation.street_map import StreetMap
from bags.street.town import Ground, Suspension
from lcd_common import se3

_ACCELERATION, _BRAKING, _LATERAL = 1.6, 2.2, 2.2  # m/s^2
_YAW_RATE = 0.65  # rad/s
_GRID_HZ = 50.0
_SMOOTH_S = 0.4
_STANDS_S = 2.0  # before it starts and after it has stopped
_SEED_OF_SUSPENSION = 23


class Journey:
    """The motion of base_link during one drive, from rest to rest.

    Attributes:
        plan: the streets driven, with the metres and the shares of revisits that came out.
        path: the line driven.
        duration_s: of the drive.
    """

    def __init__(
        self,
        streets: StreetMap,
        ground: Ground,
        settings: JourneyConfig | None = None,
        seed: int = 0,
        run: int = 0,
    ) -> None:
        """Plan a drive.

        Args:
            streets: to drive on.
            ground: that they lie on.
            settings: what the drive is like.
            seed: of the streets chosen, the same in all runs.
            run: of what differs from time to time: place in the lane, speeds, stops.
        """
        settings = settings or JourneyConfig()
        rng = np.random.default_rng([seed, 22, run])
        planned = itinerary(streets, settings, seed)
        self.path: Path = lay_path(streets, planned, settings, rng)
        self.plan: Itinerary = planned.driven(self.path.leg_m().tolist())
        self._ground = ground
        self._suspension = Suspension(np.random.default_rng([seed, _SEED_OF_SUSPENSION]))
        steps = np.linalg.norm(np.diff(self.path.xy, axis=0), axis=1)
        s = np.concatenate([[0.0], np.cumsum(steps)])
        self._line = CubicSpline(s, self.path.xy)
        self._travelled = _in_time(s, self._line, self.path, settings, rng)
        self.duration_s = float(self._travelled.x[-1])

    def travelled(self, time_s: ArrayLike) -> se3.Array:
        """Return the distance driven [N] at times [N] since the start, metres."""
        within = np.clip(np.asarray(time_s, np.float64), 0.0, self.duration_s)
        return np.clip(self._travelled(within), self._line.x[0], self._line.x[-1])

    def T_world_base(self, time_s: ArrayLike) -> se3.Array:
        """Return the poses [N x 4 x 4] of base_link at times [N] since the start."""
        s = self.travelled(np.atleast_1d(time_s))
        xy, along = self._line(s), self._line(s, 1)
        yaw = np.arctan2(along[:, 1], along[:, 0])
        roll, pitch = self._suspension.roll_pitch(s).T
        c, n = np.cos(yaw), np.sin(yaw)
        lean = np.stack([pitch * c + roll * n, pitch * n - roll * c], axis=1)
        up = np.column_stack([lean - self._ground.slope(xy), np.ones(len(s))])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        left = np.cross(up, np.column_stack([c, n, np.zeros(len(s))]))
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        T = np.tile(np.eye(4), (len(s), 1, 1))
        T[:, :3, :3] = np.stack([np.cross(left, up), left, up], axis=-1)
        T[:, :3, 3] = np.column_stack([xy, self._ground.height(xy)])
        return T


def _in_time(
    s: se3.Array,
    line: CubicSpline,
    path: Path,
    settings: JourneyConfig,
    rng: np.random.Generator,
) -> CubicSpline:
    """Return the distance driven as a function of time."""
    first, second = line(s, 1), line(s, 2)
    bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    bend = np.maximum(bend / np.linalg.norm(first, axis=1) ** 3, 1e-6)
    top = settings.speed * rng.uniform(0.7, 1.0, path.leg.max() + 1)[path.leg]
    v = np.minimum(np.minimum(top, np.sqrt(_LATERAL / bend)), _YAW_RATE / bend)
    ends = np.flatnonzero(path.ends)
    stops = ends[rng.random(len(ends)) < settings.stops]
    waits = rng.uniform(1.5, 6.0, len(stops))
    v[stops] = v[0] = v[-1] = 0.0
    steps = np.diff(s).tolist()
    speed = v.tolist()
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], (speed[i - 1] ** 2 + 2 * _ACCELERATION * steps[i - 1]) ** 0.5)
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], (speed[i + 1] ** 2 + 2 * _BRAKING * steps[i]) ** 0.5)
    v = np.array(speed)
    t = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(s) / (v[1:] + v[:-1]))])
    for stop, wait in zip(stops, waits, strict=True):
        t[stop + 1 :] += wait
    # A stop is two points of the same distance.
    arrived = np.insert(t, stops + 1, t[stops] + waits) + _STANDS_S
    where = np.insert(s, stops + 1, s[stops])
    grid = np.arange(0.0, arrived[-1] + _STANDS_S, 1.0 / _GRID_HZ)
    travelled = np.interp(grid, arrived, where)
    smooth = gaussian_filter1d(travelled, _SMOOTH_S * _GRID_HZ, mode='nearest')
    return CubicSpline(grid, smooth)
