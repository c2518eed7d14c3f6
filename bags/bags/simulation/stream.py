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
from bags.simulation.lidar_measurement import (
    Draws,
    Neighbours,
    Surfaces,
    beam_errors,
    measure,
    neighbours,
)
from bags.simulation.lidar_model import LidarModel, lidar_model
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
                yield tuple(self._sweeps(held, poses, sensor))

    def sweeps(self) -> Iterator[StreamedSweep]:
        """Yield sweeps of random places without end."""
        while True:
            held, edge = self._place()
            s = float(self._rng.uniform(0.0, edge.length_m))
            sensor = str(self._rng.choice(self.settings.sensors))
            reverse = bool(self._rng.random() < 0.5)
            yield self._sweeps(held, [self._pose(held.town, edge, s, reverse)], sensor)[0]

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

    def _sweeps(
        self, held: _HeldTown, poses: list[tuple[se3.Array, float]], sensor: str
    ) -> list[StreamedSweep]:
        """Sweep a town from some poses, each in a run drawn at random."""
        rng, settings = self._rng, self.settings
        held.sweeps += len(poses)
        model = self.models[sensor]
        width = float(rng.choice(settings.blocked_deg))
        if width:
            begin = float(rng.uniform(0.0, 360.0))
            model = model.blocked(*model.blocked_deg, (begin, begin + width))
        runs = rng.integers(settings.runs, size=len(poses))
        times_s = rng.uniform(0.0, 600.0, len(poses))
        T = np.stack([pose for pose, _ in poses])
        clouds: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        for run in np.unique(runs).tolist():
            at = np.flatnonzero(runs == run)
            caster = self._caster(held, run, model)
            if isinstance(caster, LidarRaster):
                caster.look_with(model)
                measured = measured_sweeps(caster, T[at], times_s[at], rng)
            else:
                measured = [
                    _tensors(
                        LidarSensor(model, caster, int(rng.integers(8))), T[k], times_s[k], rng
                    )
                    for k in at.tolist()
                ]
            clouds.update(zip(at.tolist(), measured, strict=True))
        return [
            StreamedSweep(*clouds[k], *pose, held.town.seed, int(runs[k]), sensor)
            for k, pose in enumerate(poses)
        ]

    def _caster(self, held: _HeldTown, run: int, model: LidarModel) -> EmbreeCaster | LidarRaster:
        if run not in held.casters:
            scene = held.town.scene(run)
            held.casters[run] = (
                EmbreeCaster(scene) if self._embree else LidarRaster(scene, model, self.device)
            )
        return held.casters[run]

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


def _tensors(
    lidar: LidarSensor, T_world_lidar: se3.Array, time_s: float, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    cloud = lidar.sweep(T_world_lidar, time_s, rng).cloud
    intensity = np.zeros(len(cloud), np.float32) if cloud.intensity is None else cloud.intensity
    return torch.from_numpy(cloud.xyz), torch.from_numpy(intensity.astype(np.float32))


def measured_sweeps(
    raster: LidarRaster, T_world_lidar: se3.Array, time_s: se3.Array, rng: np.random.Generator
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Cast and measure sweeps at poses [P x 4 x 4] and times [P], all at once.

    Returns:
        Of each sweep, its points [N x 3] in the lidar frame and their intensity [N].
    """
    model, device = raster.model, raster.device
    hits = raster.cast(T_world_lidar, time_s)
    shape = hits.range_m.shape
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 62)))

    def tensor(array: np.ndarray) -> torch.Tensor:
        dtype = torch.float32 if array.dtype.kind == 'f' else None
        return torch.as_tensor(array, dtype=dtype, device=device)

    def drawn(weaker: Draws | None = None) -> Draws:
        normal = torch.randn((2, *shape), generator=generator, device=device)
        uniform = torch.rand((2, *shape), generator=generator, device=device)
        return Draws(normal[0], normal[1], uniform[0], uniform[1], weaker)

    reflectivity = tensor(REFLECTIVITY)[hits.label, hits.material]
    R, t = tensor(T_world_lidar[:, :3, :3]), tensor(T_world_lidar[:, :3, 3])
    finite = torch.where(torch.isfinite(hits.range_m), hits.range_m, 0.0)
    along = (raster.directions.reshape(1, -1, 3) @ R.mT).view(*shape, 3)
    xyz_world = finite[..., None] * along + t[:, None, None]
    surfaces = Surfaces(
        hits.range_m,
        hits.incidence,
        (reflectivity * patchiness(xyz_world, torch)).clamp(0.02, 1.0),
        tensor(RETURN_SHARE)[hits.material],
    )
    near = neighbours(model, rng.random(shape[1:], np.float32))
    before = torch.arange(shape[0], device=device)[:, None, None] * (shape[1] * shape[2])
    near = Neighbours(tensor(near.index) + before, tensor(near.spacing_rad))
    seeds = rng.integers(8, size=shape[0]).tolist()
    beam_error_m = tensor(np.stack([beam_errors(model, seed) for seed in seeds]))[:, None]
    draws = drawn(drawn() if model.dual_return else None)
    echoes = measure(surfaces, near, draws, model, beam_error_m, torch)
    is_open = tensor(model.open_columns())[:, None]
    both = [echoes] if echoes.weaker is None else [echoes, echoes.weaker]
    sweeps = []
    for index, seed in enumerate(seeds):
        xyz, intensity = [], []
        for echo in both:
            range_m = echo.range_m[index]
            returned = torch.isfinite(range_m) & is_open
            xyz.append(raster.calibrated(seed)[returned] * range_m[returned][:, None])
            intensity.append(echo.intensity[index][returned])
        sweeps.append((torch.cat(xyz), torch.cat(intensity)))
    return sweeps
