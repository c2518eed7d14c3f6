"""Places to learn from: sweeps of one spot by several drives, kept small on disk."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from lcd_common import se3
from lcd_common.cloud import PointCloud, voxel_first
from lcd_common.errors import DataError

# Coordinates are kept in centimetres, intensity in 255 steps.
_STEP_M = 0.01
VOXEL_M, REACH_M = 0.2, 75.0
# Distances of the other sweeps of a place from its first one: a loop, and one farther away.
APART_M = ((0.0, 4.0), (4.0, 15.0))


@dataclass(frozen=True)
class PlaceSweep:
    """A sweep in the base frame.

    Attributes:
        xyz: [N x 3] float32, metres.
        intensity: [N] float32, 0..1.
        T_world_base: [4 x 4].
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    T_world_base: se3.Array


@dataclass(frozen=True)
class Place:
    """Sweeps of one place; `town` tells places of different towns apart."""

    town: int
    sweeps: tuple[PlaceSweep, ...]


class PlaceShard:
    """Places of one town, compact in memory."""

    def __init__(self, town: int, arrays: dict[str, NDArray[np.generic]]) -> None:
        self.town, self._arrays = town, arrays

    def __len__(self) -> int:
        return len(self._arrays['T_world_base']) // self.per_place

    @property
    def per_place(self) -> int:
        """Sweeps of a place."""
        return int(self._arrays['per_place'][0])

    def place(self, number: int) -> Place:
        """Return one place."""
        a, per = self._arrays, self.per_place
        sweeps = []
        for k in range(number * per, (number + 1) * per):
            part = slice(int(a['begin'][k]), int(a['begin'][k + 1]))
            xyz = a['steps'][part].astype(np.float32) * np.float32(_STEP_M)
            intensity = a['intensity'][part].astype(np.float32) / np.float32(255.0)
            sweeps.append(PlaceSweep(xyz, intensity, a['T_world_base'][k]))
        return Place(self.town, tuple(sweeps))

    def save(self, path: Path) -> None:
        """Write the shard; a file that is there is complete."""
        part = path.with_suffix('.part')
        save_file(dict(self._arrays), part, {'town': str(self.town)})
        part.replace(path)

    @classmethod
    def load(cls, path: Path) -> 'PlaceShard':
        """Read a shard; raises DataError when it is none."""
        try:
            return cls(int(path.stem.split('_')[-1]), load_file(path))
        except Exception as error:
            raise DataError(
                f'{path} holds no places ({error}); delete it to make it anew'
            ) from error


def shard_of(town: int, places: Sequence[Sequence[PlaceSweep]]) -> PlaceShard:
    """Return a shard of places with equally many sweeps each."""
    sweeps = [sweep for place in places for sweep in place]
    begin = np.cumsum([0, *(len(sweep.xyz) for sweep in sweeps)])
    steps = np.concatenate([sweep.xyz for sweep in sweeps]) / _STEP_M
    return PlaceShard(
        town,
        {
            'begin': begin.astype(np.int64),
            'steps': np.rint(steps).astype(np.int16),
            'intensity': np.rint(
                255.0 * np.concatenate([sweep.intensity for sweep in sweeps]).clip(0.0, 1.0)
            ).astype(np.uint8),
            'T_world_base': np.array([sweep.T_world_base for sweep in sweeps]),
            'per_place': np.array([len(places[0])]),
        },
    )


def thinned(cloud: PointCloud) -> PointCloud:
    """Return one point for each small voxel within reach: what training needs of a sweep."""
    cloud = cloud.within(2.0, REACH_M)
    return cloud.select(voxel_first(cloud.xyz, VOXEL_M))


def simulated_shard(
    town: int,
    count: int,
    sensors: Sequence[str],
    *,
    runs: int = 3,
    device: torch.device | str = 'cpu',
    progress: Callable[[], None] = lambda: None,
) -> PlaceShard:
    """Sweep `count` places of a simulated town (needs the package bags)."""
    from bags.simulation.stream import StreamConfig, SweepStream

    settings = StreamConfig(sensors=tuple(sensors), sweeps_per_town=10**9, towns_held=1, runs=runs)
    stream = SweepStream([town], settings, device=device, seed=town)
    places = []
    for streamed in islice(stream.places(APART_M), count):
        sweeps = []
        for one in streamed:
            up = np.array([0.0, 0.0, one.height_m])
            cloud = PointCloud(
                one.xyz.cpu().numpy() + up.astype(np.float32), one.intensity.cpu().numpy()
            )
            cloud = thinned(cloud)
            T_world_base = one.T_world_lidar @ se3.from_rotation_translation(np.eye(3), -up)
            assert cloud.intensity is not None
            sweeps.append(PlaceSweep(cloud.xyz, cloud.intensity, T_world_base))
        places.append(sweeps)
        progress()
    return shard_of(town, places)


def shards(folder: Path) -> Iterator[PlaceShard]:
    """Read the shards of a folder, by town."""
    for path in sorted(folder.glob('places_*.safetensors')):
        yield PlaceShard.load(path)
