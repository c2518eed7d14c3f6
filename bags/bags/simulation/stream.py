"""Stream simulated sweeps into training, on any device, without files.

Towns are built by numpy and cast by Embree or torch: neither Open3D nor ROS is needed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec

import numpy as np
import torch

from bags.simulation.embree import EmbreeCaster
from bags.simulation.lidar import LidarSensor
from bags.simulation.lidar_measurement import Draws, Surfaces, beam_errors, measure, neighbours
from bags.simulation.lidar_model import lidar_model
from bags.simulation.raster import LidarRaster
from bags.simulation.reflectivity import REFLECTIVITY, patchiness
from bags.simulation.street_map import StreetEdge
from bags.simulation.town import SimulatedTown
from bags.street.mesh import RETURN_SHARE
from lcd_common import se3
from lcd_common.errors import ConfigError

_TRIES = 50
TRAIN_SEEDS, VALIDATION_SEEDS, TEST_SEEDS = range(100), range(100, 110), range(200, 210)


@dataclass(frozen=True)
class StreamConfig:
    """What is streamed.

    Attributes:
        sensors: names of bags.simulation.lidar_model.LIDARS, drawn at random for each place.
        sweeps_per_town: after which the oldest town held gives way to a new one.
        towns_held: at a time, on the device.
        runs: of a town, to draw from; sweeps of one place come from two of them at random.
        height_m: (least, most) of the sensor above the road.
        tilt_rad: standard deviation of roll and pitch.
        lane_m: (least, most) distance right of the centreline.
        blocked_deg: widths of random sectors that may be blocked; 0 leaves the sweep whole.
        caster: 'embree' (Open3D, the CPU), 'torch' (any device), or 'auto': Embree for a CPU where
            Open3D is installed.
    """

    sensors: tuple[str, ...] = ('hdl64',)
    sweeps_per_town: int = 400
    towns_held: int = 3
    runs: int = 3
    height_m: tuple[float, float] = (1.6, 1.9)
    tilt_rad: float = 0.01
    lane_m: tuple[float, float] = (0.5, 3.0)
    blocked_deg: tuple[float, ...] = (0.0,)
    caster: str = 'auto'


@dataclass(frozen=True)
class StreamedSweep:
    """One sweep.

    Attributes:
        xyz: [N x 3] float32 on the stream's device, lidar frame, metres.
        intensity: [N] 0..1.
        T_world_lidar: [4 x 4] float64.
        height_m: of the sensor above the road.
        town, run, sensor: where from.
    """

    xyz: torch.Tensor
    intensity: torch.Tensor
    T_world_lidar: se3.Array
    height_m: float
    town: int
    run: int
    sensor: str


@dataclass
class _HeldTown:
    town: SimulatedTown
    casters: dict[int, EmbreeCaster | LidarRaster] = field(default_factory=dict)
    sweeps: int = 0


class SweepStream:
    """Draw places of many towns and sweep them; the same seed gives the same stream."""

    def __init__(
        self,
        seeds: Sequence[int],
        settings: StreamConfig | None = None,
        *,
        device: torch.device | str = 'cpu',
        seed: int = 0,
        styles: Sequence[str | None] = (None,),
    ) -> None:
        """Start a stream.

        Args:
            seeds: of the towns, TRAIN_SEEDS for training.
            settings: what is streamed.
            device: where sweeps are cast and returned.
            seed: of everything that is drawn.
            styles: of the towns, drawn at random.

        Raises:
            ConfigError: there is no sensor or caster of a name, or no town.
        """
        self.settings = settings or StreamConfig()
        if not seeds:
            raise ConfigError('a stream needs the seed of at least one town')
        self._embree = _use_embree(self.settings.caster, torch.device(device))
        self.models = {name: lidar_model(name) for name in self.settings.sensors}
        self.device = torch.device(device)
        self._seeds, self._styles = list(seeds), list(styles)
        self._rng = np.random.default_rng([seed, 71])
        self._held: list[_HeldTown] = []

    def pairs(
        self, max_distance_m: float = 4.0, any_heading: bool = True
    ) -> Iterator[tuple[StreamedSweep, StreamedSweep]]:
        """Yield two sweeps of one place, at most so far apart, without end."""
        for sweeps in self.places([(0.0, max_distance_m)], any_heading):
            yield sweeps[0], sweeps[1]

    def places(
        self, apart_m: Sequence[tuple[float, float]], any_heading: bool = True
    ) -> Iterator[tuple[StreamedSweep, ...]]:
        """Yield sweeps of one place without end, each of a run drawn at random.

        Args:
            apart_m: (least, most) distance from the first sweep, for each of the others.
            any_heading: draw the directions of travel; else all of a place go the same way.
        """
        while True:
            held, edge = self._place()
            s = float(self._rng.uniform(0.0, edge.length_m))
            sensor = str(self._rng.choice(self.settings.sensors))
            reverse = bool(self._rng.random() < 0.5)
            poses = [self._pose(held.town, edge, s, reverse)]
            for least, most in apart_m:
                for _ in range(_TRIES):
                    if any_heading:
                        reverse = bool(self._rng.random() < 0.5)
                    near = s + float(self._rng.uniform(-most, most))
                    T = self._pose(held.town, edge, near, reverse)
                    if least <= se3.distance(poses[0][0], T[0])[0] <= most:
                        poses.append(T)
                        break
            # A short street may have no pose as far away as was asked.
            if len(poses) == 1 + len(apart_m):
                yield tuple(self._sweep(held, T, sensor) for T in poses)

    def sweeps(self) -> Iterator[StreamedSweep]:
        """Yield sweeps of random places without end."""
        while True:
            held, edge = self._place()
            s = float(self._rng.uniform(0.0, edge.length_m))
            sensor = str(self._rng.choice(self.settings.sensors))
            reverse = bool(self._rng.random() < 0.5)
            yield self._sweep(held, self._pose(held.town, edge, s, reverse), sensor)

    def _place(self) -> tuple[_HeldTown, StreetEdge]:
        """Draw a town that is held, and a street of it."""
        settings, rng = self.settings, self._rng
        if self._held and self._held[0].sweeps >= settings.sweeps_per_town:
            self._held.pop(0)
        while len(self._held) < min(settings.towns_held, len(self._seeds)):
            style = self._styles[int(rng.integers(len(self._styles)))]
            self._held.append(_HeldTown(SimulatedTown(int(rng.choice(self._seeds)), style)))
        held = self._held[int(rng.integers(len(self._held)))]
        lengths = np.array([edge.length_m for edge in held.town.streets.edges])
        chosen = int(rng.choice(len(lengths), p=lengths / lengths.sum()))
        return held, held.town.streets.edges[chosen]

    def _sweep(self, held: _HeldTown, pose: tuple[se3.Array, float], sensor: str) -> StreamedSweep:
        rng, run = self._rng, int(self._rng.integers(self.settings.runs))
        T, height_m = pose
        held.sweeps += 1
        model = self.models[sensor]
        width = float(rng.choice(self.settings.blocked_deg))
        if width:
            begin = float(rng.uniform(0.0, 360.0))
            model = model.blocked(*model.blocked_deg, (begin, begin + width))
        time_s = float(rng.uniform(0.0, 600.0))
        if run not in held.casters:
            scene = held.town.scene(run)
            held.casters[run] = (
                EmbreeCaster(scene) if self._embree else LidarRaster(scene, model, self.device)
            )
        caster = held.casters[run]
        if isinstance(caster, LidarRaster):
            caster.look_with(model)
            xyz, intensity = measured_sweep(caster, T, time_s, rng)
        else:
            cloud = LidarSensor(model, caster, int(rng.integers(8))).sweep(T, time_s, rng).cloud
            xyz = torch.from_numpy(cloud.xyz)
            values = (
                np.zeros(len(cloud), np.float32) if cloud.intensity is None else cloud.intensity
            )
            intensity = torch.from_numpy(values.astype(np.float32))
        return StreamedSweep(xyz, intensity, T, height_m, held.town.seed, run, sensor)

    def _pose(
        self, town: SimulatedTown, edge: StreetEdge, s: float, reverse: bool
    ) -> tuple[se3.Array, float]:
        """Draw T_world_lidar in a lane `s` metres along a street, and the sensor's height."""
        rng, settings = self._rng, self.settings
        lane = min(float(rng.uniform(*settings.lane_m)), 0.5 * edge.half_width_m)
        s = float(np.clip(s, 0.0, edge.length_m))
        xy, direction = edge.at(s)
        heading = np.arctan2(direction[1], direction[0]) + (np.pi if reverse else 0.0)
        xy = xy + lane * np.array([np.sin(heading), -np.cos(heading)])
        height_m = float(rng.uniform(*settings.height_m))
        roll, pitch = rng.normal(0.0, settings.tilt_rad, 2)
        T = se3.rotation_z(float(heading + rng.normal(0.0, 0.03)))
        T = T @ se3.exp(np.array([0.0, 0.0, 0.0, roll, pitch, 0.0]))
        T[:3, 3] = *xy, float(town.ground.height(xy[None])[0]) + height_m
        return np.asarray(T), height_m


def _use_embree(caster: str, device: torch.device) -> bool:
    if caster not in ('auto', 'embree', 'torch'):
        raise ConfigError(f'the caster is auto, embree or torch, got {caster!r}')
    if caster != 'auto':
        return caster == 'embree'
    return device.type == 'cpu' and find_spec('open3d') is not None


def measured_sweep(
    raster: LidarRaster, T_world_lidar: se3.Array, time_s: float, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cast and measure one sweep; return points [N x 3], lidar frame, and intensity [N]."""
    model, device = raster.model, raster.device
    hits = raster.cast(T_world_lidar, time_s)
    shape = hits.range_m.shape
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 62)))
    normal = torch.randn((2, *shape), generator=generator, device=device)
    uniform = torch.rand((2, *shape), generator=generator, device=device)
    to_device = {'dtype': torch.float32, 'device': device}
    reflectivity = torch.as_tensor(REFLECTIVITY, **to_device)[hits.label, hits.material]  # type: ignore[call-overload]
    R, t = (
        torch.as_tensor(part, **to_device) for part in (T_world_lidar[:3, :3], T_world_lidar[:3, 3])
    )  # type: ignore[call-overload]
    finite = torch.where(torch.isfinite(hits.range_m), hits.range_m, 0.0 * normal[0])
    xyz_world = (finite[..., None] * raster.directions) @ R.T + t
    surfaces = Surfaces(
        hits.range_m,
        hits.incidence,
        (reflectivity * patchiness(xyz_world, torch)).clamp(0.02, 1.0),
        torch.as_tensor(RETURN_SHARE, **to_device)[hits.material],  # type: ignore[call-overload]
    )
    near = neighbours(model, rng.random(shape, np.float32))
    near = type(near)(
        torch.as_tensor(near.index, device=device),
        torch.as_tensor(near.spacing_rad, device=device),
    )
    seed = int(rng.integers(8))
    beam_error_m = torch.as_tensor(beam_errors(model, seed), **to_device)  # type: ignore[call-overload]
    draws = Draws(normal[0], normal[1], uniform[0], uniform[1])
    echoes = measure(surfaces, near, draws, model, beam_error_m, torch)
    returned = torch.isfinite(echoes.range_m)
    returned &= torch.as_tensor(model.open_columns(), device=device)[:, None]
    xyz = raster.calibrated(seed)[returned] * echoes.range_m[returned][:, None]
    return xyz, echoes.intensity[returned]
