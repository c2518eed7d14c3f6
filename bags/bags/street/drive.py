"""A drive through the analytic town, as if it had been recorded."""

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import cached_property
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from bags.records import (
    CameraModel,
    GnssFix,
    ImuSample,
    LidarScan,
    Mounting,
    Record,
    Stream,
    TruthPose,
)
from bags.street import route as routes
from bags.street.lidar import LidarConfig, SpinningLidar
from bags.street.town import Ground, Suspension, Town
from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory

ROUTES = {'loop': routes.loop, 'abrupt_u_turn': routes.abrupt_u_turn}
T_BASE_LIDAR = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 1.73])
T_BASE_IMU = se3.from_rotation_translation(np.eye(3), [-0.3, 0.2, 0.6])
T_BASE_GPS = se3.from_rotation_translation(np.eye(3), [-0.6, 0.0, 1.6])
_GRAVITY = 9.81
_EQUATOR_M, _SQUARED_ECCENTRICITY = 6378137.0, 6.69437999014e-3  # WGS-84


@config
class StreetConfig:
    """What is recorded in the town."""

    seed: int = setting(0, 'of the town and of all noise', low=0)
    epoch_s: int = setting(1_700_000_000, 'stamp of the first sweep since 1970', unit='s', low=1)
    imu_rate: float = setting(100.0, 'IMU samples per second; 0 is none', unit='Hz', low=0.0)
    gyro_noise: float = setting(0.002, 'standard deviation of a sample', unit='rad/s', low=0.0)
    accelerometer_noise: float = setting(0.03, 'of a sample', unit='m/s^2', low=0.0)
    gnss_rate: float = setting(1.0, 'satellite fixes per second; 0 is none', unit='Hz', low=0.0)
    gnss_noise: float = setting(0.8, 'standard deviation of a fix, each axis', unit='m', low=0.0)
    latitude: float = setting(49.0, 'of the origin of the world', unit='deg', low=-80.0, high=80.0)
    longitude: float = setting(8.4, 'of the origin', unit='deg', low=-180.0, high=180.0)


class StreetDrive:
    """A Drive (`bags.records`) whose sweeps are cast when they are asked for.

    The same route and settings give the same records, whatever part of the drive is read first.
    World axes: x east, y north, z up. Stamps of sweeps are those of their first column.
    """

    camera: CameraModel | None = None
    mountings: tuple[Mounting, ...] = (
        Mounting('base_link', 'lidar', T_BASE_LIDAR),
        Mounting('base_link', 'imu', T_BASE_IMU),
        Mounting('base_link', 'gps', T_BASE_GPS),
    )

    def __init__(
        self,
        route: 'routes.Route | str' = 'loop',
        settings: StreetConfig | None = None,
        lidar: LidarConfig | None = None,
    ) -> None:
        """Plan the drive.

        Args:
            route: a Route, or the name of a ready-made one: loop, abrupt_u_turn.
            settings: seed, IMU and satellite receiver.
            lidar: the scanner.

        Raises:
            ConfigError: there is no route of that name.
        """
        if isinstance(route, str):
            if route not in ROUTES:
                raise ConfigError(f'a street route is one of {", ".join(ROUTES)}, got {route!r}')
            self.name = f'street_{route}'
            self.route = ROUTES[route]()
        else:
            self.name, self.route = 'street', route
        self.path = Path(self.name)
        self.settings = settings or StreetConfig()
        self.lidar = lidar or LidarConfig()
        self.skipped: Counter[str] = Counter()
        self.ground = Ground(np.random.default_rng([self.settings.seed, 1]))
        self._suspension = Suspension(np.random.default_rng([self.settings.seed, 5]))

    def streams(self) -> list[Stream]:
        """List what the drive holds."""
        s, rate = self.settings, self.lidar.rate
        kinds = [
            ('/points', 'sensor_msgs/msg/PointCloud2', rate),
            ('/imu', 'sensor_msgs/msg/Imu', s.imu_rate),
            ('/gps/fix', 'sensor_msgs/msg/NavSatFix', s.gnss_rate),
            ('/ground_truth/pose', 'geometry_msgs/msg/PoseStamped', rate),
        ]
        out = []
        for topic, type_name, per_second in kinds:
            number = self._count(per_second)
            if number:
                span = self._stamp(0, per_second), self._stamp(number - 1, per_second)
                out.append(Stream(topic, type_name, number, *span))
        return out

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield everything between two stamps (inclusive) in stamp order."""
        s, rate = self.settings, self.lidar.rate
        makers: list[tuple[type[Record], float, Callable[[int], Record]]] = [
            (ImuSample, s.imu_rate, self._imu),
            (GnssFix, s.gnss_rate, self._gnss),
            (TruthPose, rate, self._truth_pose),
            (LidarScan, rate, self.scan),
        ]
        streams = (
            self._stream(rank, per_second, make, start_ns, end_ns)
            for rank, (kind, per_second, make) in enumerate(makers)
            if kinds is None or kind in kinds
        )
        for _, _, index, make in heapq.merge(*streams, key=lambda item: item[:2]):
            yield make(index)

    def truth(self) -> Trajectory:
        """Return the pose of base_link at every sweep's stamp."""
        number = self._count(self.lidar.rate)
        stamps = np.array([self._stamp(i, self.lidar.rate) for i in range(number)], np.int64)
        return Trajectory(stamps, self.T_world_base((stamps - self._stamp(0, 1.0)) * 1e-9))

    def T_world_base(self, time_s: ArrayLike) -> se3.Array:
        """Return the poses [N x 4 x 4] of base_link at times [N], seconds after the first sweep."""
        x, y, yaw, travelled = self.route.at(np.atleast_1d(time_s)).T
        xy = np.stack([x, y], axis=1)
        slope = self.ground.slope(xy)
        roll, pitch = self._suspension.roll_pitch(travelled).T
        c, s = np.cos(yaw), np.sin(yaw)
        lean = np.stack([pitch * c + roll * s, pitch * s - roll * c], axis=1)
        up = np.column_stack([lean - slope, np.ones(len(x))])
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        heading = np.column_stack([c, s, np.zeros(len(x))])
        left = np.cross(up, heading)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        T = np.tile(np.eye(4), (len(x), 1, 1))
        T[:, :3, :3] = np.stack([np.cross(left, up), left, up], axis=-1)
        T[:, :3, 3] = np.column_stack([xy, self.ground.height(xy)])
        return T

    def scan(self, index: int) -> LidarScan:
        """Cast sweep `index` (0, 1, 2, ...)."""
        time_s: ArrayLike = index / self.lidar.rate
        if self.lidar.point_time:
            time_s = index / self.lidar.rate + self._scanner.column_time_s
        T_world_lidar = self.T_world_base(time_s) @ T_BASE_LIDAR
        rng = np.random.default_rng([self.settings.seed, 2, index])
        cloud = self._scanner.scan(T_world_lidar, rng)
        return LidarScan(self._stamp(index, self.lidar.rate), cloud)

    @cached_property
    def _scanner(self) -> SpinningLidar:
        seconds = np.arange(0.0, self.route.duration_s, 0.05)
        driven = self.route.at(seconds)[:, :2]
        mesh = Town(self.ground, self.route.centrelines, driven, self.settings.seed).build()
        return SpinningLidar(mesh, self.lidar)

    def _truth_pose(self, index: int) -> TruthPose:
        stamp = self._stamp(index, self.lidar.rate)
        return TruthPose(stamp, self.T_world_base(index / self.lidar.rate)[0])

    def _imu(self, index: int) -> ImuSample:
        h = 0.005
        t = index / self.settings.imu_rate
        before, now, after = self.T_world_base([t - h, t, t + h]) @ T_BASE_IMU
        R_world_imu = now[:3, :3]
        rate = se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h)
        force = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2 + [0.0, 0.0, _GRAVITY]
        noise = np.random.default_rng([self.settings.seed, 3, index]).normal(size=6)
        return ImuSample(
            self._stamp(index, self.settings.imu_rate),
            rate + noise[:3] * self.settings.gyro_noise,
            R_world_imu.T @ force + noise[3:] * self.settings.accelerometer_noise,
        )

    def _gnss(self, index: int) -> GnssFix:
        s = self.settings
        rng = np.random.default_rng([s.seed, 4, index])
        at = (self.T_world_base(index / s.gnss_rate) @ T_BASE_GPS)[0, :3, 3]
        east, north, up = at + rng.normal(0.0, s.gnss_noise, 3)
        # Radii of curvature at the origin: millimetres off over the few hundred metres of a town.
        sine = np.sin(np.radians(s.latitude))
        normal = _EQUATOR_M / np.sqrt(1 - _SQUARED_ECCENTRICITY * sine**2)
        meridian = normal * (1 - _SQUARED_ECCENTRICITY) / (1 - _SQUARED_ECCENTRICITY * sine**2)
        return GnssFix(
            self._stamp(index, s.gnss_rate),
            s.latitude + float(np.degrees(north / meridian)),
            s.longitude + float(np.degrees(east / (normal * np.cos(np.radians(s.latitude))))),
            float(up),
            np.eye(3) * s.gnss_noise**2 if s.gnss_noise else None,
        )

    def _count(self, rate: float) -> int:
        return int(self.route.duration_s * rate) + 1 if rate else 0

    def _stamp(self, index: int, rate: float) -> int:
        return self.settings.epoch_s * 1_000_000_000 + round(index * 1e9 / rate)

    def _stream(
        self,
        rank: int,
        rate: float,
        make: Callable[[int], Record],
        start_ns: int | None,
        end_ns: int | None,
    ) -> Iterator[tuple[int, int, int, Callable[[int], Record]]]:
        first = self._stamp(0, 1.0)
        begin = 0 if start_ns is None else max(0, int((start_ns - first) * 1e-9 * rate) - 1)
        for index in count(begin):
            if index >= self._count(rate):
                return
            stamp = self._stamp(index, rate)
            if end_ns is not None and stamp > end_ns:
                return
            if start_ns is None or stamp >= start_ns:
                yield stamp, rank, index, make
