"""A drive through a simulated town, as if it had been recorded."""

import heapq
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.records import (
    CameraImage,
    CameraModel,
    GnssFix,
    ImuSample,
    LidarScan,
    Mounting,
    Record,
    Stream,
    TruthPose,
)
from bags.simulation import car
from bags.simulation.inertial import InertialLog, felt, imu_model, measured
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.journey import Journey
from bags.simulation.lidar import LidarSensor, LidarSweep
from bags.simulation.lidar_model import LidarModel, lidar_model
from bags.simulation.road_users import kept_clear
from bags.simulation.satellites import ReceiverConfig, Reception, geodetic, receive
from bags.simulation.town import SimulatedTown
from bags.topics import ORDER, TOPICS
from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory


@config
class SensorsConfig:
    """What the simulated car carries."""

    lidar: str = setting('hdl64', 'model of the LiDAR (bags.simulation.lidar_model)')
    blocked: tuple[float, ...] = setting(
        (),
        'azimuths of sectors in which something blocks the LiDAR: begin, end, begin, end ..., '
        'counter-clockwise from straight ahead',
        unit='deg',
    )
    point_time: bool = setting(
        False, 'sweep while driving and give each point its time; off: sweeps are deskewed'
    )
    dual_return: bool = setting(
        False, 'where a beam touches two surfaces, a point of each; off: of the stronger one'
    )
    labels: bool = setting(
        True, "what each point lies on and whether it moves, SemanticKITTI's way"
    )
    camera: bool = setting(False, 'an image with each sweep')
    imu: str = setting('rt3003', 'inertial unit; empty is none')
    imu_rate: float = setting(100.0, 'of its samples', unit='Hz', low=1.0, high=1000.0)
    gnss: bool = setting(True, 'a satellite receiver')
    epoch_s: int = setting(1_700_000_000, 'stamp of the first sweep since 1970', unit='s', low=1)


class SimulatedDrive:
    """A Drive (`bags.records`) whose sweeps and images are cast when they are asked for.

    The same town, run and settings give the same records, whatever is read first. World axes: x
    east, y north, z up. Stamps of sweeps are those of their first column.
    """

    def __init__(
        self,
        town: SimulatedTown | int,
        run: int = 0,
        journey: JourneyConfig | None = None,
        sensors: SensorsConfig | None = None,
        receiver: ReceiverConfig | None = None,
    ) -> None:
        """Plan the drive.

        Args:
            town: or its seed.
            run: the same streets at another time: other cars, light, lane, speed and noise.
            journey: length and revisits.
            sensors: what is recorded.
            receiver: the satellite receiver.

        Raises:
            ConfigError: there is no LiDAR or inertial unit of that name, or the LiDAR sees nothing.
        """
        self.town = SimulatedTown(town) if isinstance(town, int) else town
        self.run = run
        self.sensors = sensors or SensorsConfig()
        self._receiver = receiver or ReceiverConfig()
        lidar = replace(lidar_model(self.sensors.lidar), dual_return=self.sensors.dual_return)
        self.lidar = _partly_blocked(lidar, self.sensors.blocked)
        self._imu_model = imu_model(self.sensors.imu) if self.sensors.imu else None
        self.name = f'town_{self.town.seed}_run{run}'
        self.path = Path(self.name)
        self.skipped: Counter[str] = Counter()
        self.camera: CameraModel | None = car.camera_model() if self.sensors.camera else None
        there = [
            (car.LIDAR, True),
            (car.CAMERA, self.sensors.camera),
            (car.IMU, self._imu_model is not None),
            (car.GPS, self.sensors.gnss),
        ]
        self.mountings: tuple[Mounting, ...] = tuple(m for m, is_there in there if is_there)
        self._seed = self.town.seed * 1009 + run
        self.journey = Journey(
            self.town.streets, self.town.ground, journey, seed=self.town.seed, run=run
        )

    def streams(self) -> list[Stream]:
        """List what the drive holds; with satellites this builds the town, houses hide them."""
        return [
            Stream(*TOPICS[kind], len(stamps), int(stamps[0]), int(stamps[-1]))
            for kind, stamps, _ in sorted(self._sources(), key=lambda item: -ORDER[item[0]])
            if len(stamps)
        ]

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield everything between two stamps (inclusive) in stamp order."""
        streams = (
            _entries(ORDER[kind], stamps, make, start_ns, end_ns)
            for kind, stamps, make in self._sources(kinds)
        )
        for _, _, index, make in heapq.merge(*streams, key=lambda item: item[:2]):
            yield make(index)

    def truth(self) -> Trajectory:
        """Return the pose of base_link at every sweep's stamp."""
        stamps = self._stamps(self.lidar.rate_hz)
        return Trajectory(stamps, self.journey.T_world_base(self._time_s(stamps)))

    def sweep(self, index: int) -> LidarSweep:
        """Cast sweep `index` (0, 1, 2, ...) with labels and moving flags."""
        time_s = index / self.lidar.rate_hz
        T = self.journey.T_world_base(time_s)[0] @ car.LIDAR.T_parent_child
        if self.sensors.point_time:
            at = time_s + self.lidar.column_time_s()
            T = self.journey.T_world_base(at) @ car.LIDAR.T_parent_child
        rng = np.random.default_rng([self._seed, 51, index])
        return self._lidar.sweep(T, time_s, rng)

    def scan(self, index: int) -> LidarScan:
        """Cast sweep `index` as it would be recorded."""
        sweep = self.sweep(index)
        label = sweep.label.astype(np.uint16) if self.sensors.labels else None
        cloud = replace(sweep.cloud, label=label)
        return LidarScan(self._stamp(index / self.lidar.rate_hz), cloud)

    def image(self, index: int) -> CameraImage:
        """Render the image that belongs to sweep `index`."""
        if self.camera is None:
            raise ValueError('this car has no camera; SensorsConfig(camera=True) gives it one')
        time_s = index / self.lidar.rate_hz
        T_world_camera = self.journey.T_world_base(time_s)[0] @ car.CAMERA.T_parent_child
        rng = np.random.default_rng([self._seed, 52, index])
        pixels = self._renderer.render(T_world_camera, self.camera, time_s, rng)
        return CameraImage(self._stamp(time_s), pixels)

    def _sources(
        self, kinds: Collection[type[Record]] | None = None
    ) -> list[tuple[type[Record], NDArray[np.int64], Callable[[int], Record]]]:
        """List what the car carries: kind, stamps [N], and how the record of a stamp is made."""
        sweeps = self._stamps(self.lidar.rate_hz)
        sources: list[tuple[type[Record], NDArray[np.int64], Callable[[int], Record]]] = []
        if kinds is None or LidarScan in kinds:
            sources.append((LidarScan, sweeps, self.scan))
        if kinds is None or TruthPose in kinds:
            sources.append((TruthPose, sweeps, self._truth_pose))
        if self.camera is not None and (kinds is None or CameraImage in kinds):
            sources.append((CameraImage, sweeps, self.image))
        if self._imu_model is not None and (kinds is None or ImuSample in kinds):
            sources.append((ImuSample, self._stamps(self.sensors.imu_rate), self._imu))
        if self.sensors.gnss and (kinds is None or GnssFix in kinds):
            stamps = self._stamps(self._receiver.rate)[self._reception.has_fix]
            sources.append((GnssFix, stamps, self._gnss))
        return sources

    @cached_property
    def _caster(self):  # type: ignore[no-untyped-def]
        from bags.simulation.embree import EmbreeCaster

        scene = self.town.scene(self.run)
        return EmbreeCaster(kept_clear(scene, self.journey))

    @cached_property
    def _lidar(self) -> LidarSensor:
        return LidarSensor(self.lidar, self._caster, seed=self.town.seed)

    @cached_property
    def _renderer(self):  # type: ignore[no-untyped-def]
        from bags.simulation.camera import CameraRenderer

        return CameraRenderer(self._caster)

    @cached_property
    def _inertial(self) -> InertialLog:
        assert self._imu_model is not None
        time_s = self._time_s(self._stamps(self.sensors.imu_rate))
        true = felt(self.journey.T_world_base, car.IMU.T_parent_child, time_s)
        return measured(true, self._imu_model, self.sensors.imu_rate, self._seed)

    @cached_property
    def _reception(self) -> Reception:
        time_s = self._time_s(self._stamps(self._receiver.rate))
        antenna = (self.journey.T_world_base(time_s) @ car.GPS.T_parent_child)[:, :3, 3]
        return receive(antenna, self._caster, self._receiver, self._seed)

    def _truth_pose(self, index: int) -> TruthPose:
        time_s = index / self.lidar.rate_hz
        return TruthPose(self._stamp(time_s), self.journey.T_world_base(time_s)[0])

    def _imu(self, index: int) -> ImuSample:
        log = self._inertial
        return ImuSample(
            self._stamp(index / self.sensors.imu_rate),
            log.angular_velocity[index],
            log.linear_acceleration[index],
        )

    def _gnss(self, index: int) -> GnssFix:
        """Return the fix of a number that counts fixes, not the periods without one."""
        period = int(np.flatnonzero(self._reception.has_fix)[index])
        time_s = period / self._receiver.rate
        T = self.journey.T_world_base(time_s)[0] @ car.GPS.T_parent_child
        at = geodetic(T[:3, 3] + self._reception.error_enu[period], self._receiver)
        return GnssFix(self._stamp(time_s), *at, self._reception.covariance_enu[period])

    def _stamps(self, rate_hz: float) -> NDArray[np.int64]:
        count = int(self.journey.duration_s * rate_hz) + 1
        return np.array([self._stamp(k / rate_hz) for k in range(count)], np.int64)

    def _stamp(self, time_s: float) -> int:
        return self.sensors.epoch_s * 1_000_000_000 + round(time_s * 1e9)

    def _time_s(self, stamps_ns: NDArray[np.int64]) -> se3.Array:
        return np.asarray((stamps_ns - self._stamp(0.0)) * 1e-9, np.float64)


def _partly_blocked(model: LidarModel, azimuths_deg: tuple[float, ...]) -> LidarModel:
    begins, ends = azimuths_deg[::2], azimuths_deg[1::2]
    if len(begins) != len(ends) or not np.isfinite(azimuths_deg).all():
        raise ConfigError(
            'blocked takes the azimuths of the begin and the end of each sector, degrees '
            f'counter-clockwise from straight ahead, got {azimuths_deg}'
        )
    model = model.blocked(*model.blocked_deg, *zip(begins, ends, strict=True))
    if any((end - begin) % 360.0 == 0.0 for begin, end in model.blocked_deg):
        raise ConfigError(f'blocked sectors are wider than 0 and less than 360, got {azimuths_deg}')
    if not model.open_columns().any():
        raise ConfigError(f'the blocked sectors {azimuths_deg} leave the LiDAR nothing to see')
    return model


def _entries(
    rank: int,
    stamps: NDArray[np.int64],
    make: Callable[[int], Record],
    start_ns: int | None,
    end_ns: int | None,
) -> Iterator[tuple[int, int, int, Callable[[int], Record]]]:
    begin = 0 if start_ns is None else int(np.searchsorted(stamps, start_ns))
    end = len(stamps) if end_ns is None else int(np.searchsorted(stamps, end_ns, 'right'))
    for index in range(begin, end):
        yield int(stamps[index]), rank, index, make
