"""Set simulated sweeps beside real ones: figures and pictures.

The comparison is by distribution: a simulated town is no copy of Karlsruhe. What is
still unlike, by figures and by looking at the pictures, is listed in benchmarks/README.md.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bags.simulation import car
from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.embree import EmbreeCaster
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.lidar import LidarSensor
from bags.simulation.lidar_model import LidarModel, lidar_model
from bags.simulation.road_users import kept_clear
from bags.simulation.town import SimulatedTown
from benchmarks import recordings, sweep_pictures
from benchmarks.sweep_statistics import RingedSweep, compared, statistics, total_variation
from lcd_common import command_line, se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError

IMAGES = recordings.ROOT / 'docs' / 'images'
# The one town, run and moment that is shown; the figures come from several of them.
_TOWN, _RUN, _MOMENT_S = 0, 2, 5.0
_KITTI_00 = (0, 52, 88, 94, 198, 850, 4501)  # places apart from each other
_KARLSRUHE = tuple(range(170, 501, 55))
# Test towns are left alone: what is seen here may change the towns.
_TOWNS, _MOMENTS = (0, 1, 2, 3), 5


def karlsruhe_model() -> LidarModel:
    """Return the HDL-64E as the Karlsruhe drive was stored: its own beams, 870 columns.

    Raises:
        DataError: the recording is not there.
    """
    azimuths = 870
    config = recordings.folder() / 'data' / 'karlsruhe_hdl64' / 'velodyne_config.txt'
    if not config.is_file():
        raise DataError(f'{config}: expected the configuration of the Karlsruhe drive')
    lines = [line for line in config.read_text().splitlines() if line and line[0] != '#']
    elevation = -np.radians(np.array(lines[0].split()[5:69], float))
    return replace(
        lidar_model('hdl64'), elevation_rad=elevation, columns=azimuths, has_intensity=False
    )


def real_sweeps(name: str) -> list[RingedSweep]:
    """Return real sweeps of KITTI 00, KITTI-360 or the Karlsruhe drive, places apart.

    Raises:
        DataError: the recordings are not there.
    """
    data = recordings.folder() / 'data'
    if name == 'karlsruhe':
        return [_karlsruhe_sweep(data / 'karlsruhe_hdl64' / 'data', i) for i in _KARLSRUHE]
    if name == 'kitti_360':
        files = [data / 'kitti_360' / 'velodyne' / f'{i:010d}.bin' for i in (3000, 3023)]
    else:
        velodyne = data / 'kitti_odometry' / 'sequences' / '00' / 'velodyne'
        files = [velodyne / f'{i:06d}.bin' for i in _KITTI_00]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise DataError(f'{missing[0]}: expected a sweep of {name}')
    rows = [np.fromfile(file, np.float32).reshape(-1, 4) for file in files]
    return [RingedSweep.in_order(PointCloud(row[:, :3], row[:, 3])) for row in rows]


def simulated_sweeps(model: LidarModel, towns: Sequence[int] = _TOWNS) -> list[RingedSweep]:
    """Return sweeps of a LiDAR at moments of a drive through each town."""
    sweeps = []
    for town in towns:
        drive = _drive(town, run=0)
        moments = np.linspace(0.1, 0.9, _MOMENTS) * drive.journey.duration_s
        sensor = LidarSensor(model, _caster(drive), seed=town)
        for k, time_s in enumerate(moments):
            T_world_lidar = drive.journey.T_world_base(time_s)[0] @ car.LIDAR.T_parent_child
            rng = np.random.default_rng([town, k])
            sweeps.append(_ringed(sensor, T_world_lidar, float(time_s), rng))
    return sweeps


def evaluate(work: Path) -> dict[str, Any]:
    """Return the figures as a section of `benchmarks.town`."""
    del work
    return {'real_vs_sim': figures()}


def figures() -> dict[str, Any]:
    """Return real against simulated, one entry per statistic and recording.

    `real_against_real` says how far two real recordings lie apart: no simulator needs to be nearer.
    """
    models = {'kitti_00': lidar_model('hdl64'), 'kitti_360': lidar_model('hdl64')}
    models['karlsruhe'] = karlsruhe_model()
    real = {name: statistics(real_sweeps(name)) for name in models}
    hdl64 = statistics(simulated_sweeps(models['kitti_00']))
    coarse = statistics(simulated_sweeps(models['karlsruhe']))
    out: dict[str, Any] = {
        'kitti_00': compared(real['kitti_00'], hdl64),
        'kitti_360': compared(real['kitti_360'], hdl64),
        'karlsruhe': compared(real['karlsruhe'], coarse),
    }
    one, other = real['kitti_00'], real['kitti_360']
    assert one.intensity_share is not None and other.intensity_share is not None
    out['real_against_real'] = {
        'range_histogram_distance': total_variation(one.range_share, other.range_share),
        'intensity_histogram_distance': total_variation(one.intensity_share, other.intensity_share),
    }
    return out


def pictures(out: Path) -> list[Path]:
    """Write the pictures and return their files, each below 300 kB."""
    out.mkdir(parents=True, exist_ok=True)
    drive = _drive(_TOWN, _RUN)
    caster = _caster(drive)
    T_world_base = drive.journey.T_world_base(_MOMENT_S)[0]
    written = []
    titles = {
        'kitti_00': 'KITTI 00, scan 0',
        'kitti_360': 'KITTI-360, frame 3000',
        'karlsruhe': 'Karlsruhe, sweep 170',
    }
    for name, title in titles.items():
        model = karlsruhe_model() if name == 'karlsruhe' else lidar_model('hdl64')
        sensor = LidarSensor(model, caster, seed=_TOWN)
        T_world_lidar = T_world_base @ car.LIDAR.T_parent_child
        sweep = _ringed(sensor, T_world_lidar, _MOMENT_S, np.random.default_rng(1))
        file = out / f'sweep_{name}.png'
        sweep_pictures.side_by_side({title: real_sweeps(name)[0], 'simulated': sweep}, file)
        written.append(file)
    written.append(_camera_picture(drive, caster, T_world_base, out / 'simulated_camera.png'))
    return written


def _camera_picture(
    drive: SimulatedDrive, caster: EmbreeCaster, T_world_base: se3.Array, file: Path
) -> Path:
    from bags.simulation.camera import CameraRenderer

    camera = car.camera_model()
    frame = CameraRenderer(caster).render(
        T_world_base @ car.CAMERA.T_parent_child, camera, _MOMENT_S, np.random.default_rng(2)
    )
    sensor = LidarSensor(drive.lidar, caster, seed=_TOWN)
    sweep = sensor.sweep(
        T_world_base @ car.LIDAR.T_parent_child, _MOMENT_S, np.random.default_rng(1)
    )
    T_camera_lidar = se3.inverse(car.CAMERA.T_parent_child) @ car.LIDAR.T_parent_child
    overlaid = sweep_pictures.overlay(frame, sweep.cloud.xyz, T_camera_lidar, camera.K)
    both = Image.fromarray(np.concatenate([frame, overlaid]))
    sweep_pictures.save_small(both.resize((900, 2 * 273), Image.Resampling.LANCZOS), file)
    return file


def _ringed(
    sensor: LidarSensor, T_world_lidar: se3.Array, time_s: float, rng: np.random.Generator
) -> RingedSweep:
    sweep = sensor.sweep(T_world_lidar, time_s, rng)
    return RingedSweep(sweep.cloud, sweep.ray % len(sensor.model.elevation_rad))


def _drive(town: int, run: int) -> SimulatedDrive:
    journey = JourneyConfig(length=600.0)
    return SimulatedDrive(SimulatedTown(town), run, journey, SensorsConfig(gnss=False))


def _caster(drive: SimulatedDrive) -> EmbreeCaster:
    return EmbreeCaster(kept_clear(drive.town.scene(drive.run), drive.journey))


def _command() -> None:
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.realism',
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='example: python -m benchmarks.realism /tmp/pictures --no-figures',
    )
    parser.add_argument('out', nargs='?', type=Path, default=IMAGES, help='folder of the pictures')
    parser.add_argument('--no-figures', action='store_true', help='draw the pictures alone')
    arguments = parser.parse_args()
    for file in pictures(arguments.out):
        sys.stdout.write(f'{file}: {file.stat().st_size / 1000:.0f} kB\n')
    if not arguments.no_figures:
        _print(figures())


def _print(entries: dict[str, Any]) -> None:
    for recording, values in entries.items():
        for name, value in values.items():
            if isinstance(value, dict):
                value = f'real {value["real"]:g}, simulated {value["simulated"]:g}'
            sys.stdout.write(f'{recording:18} {name:28} {value}\n')


def _karlsruhe_sweep(folder: Path, index: int) -> RingedSweep:
    """Unpack a range image: 16 bits, 500 to the metre, 0 where nothing came back."""
    file = folder / f'{index:010d}.png'
    if not file.is_file():
        raise DataError(f'{file}: expected a range image of the Karlsruhe drive')
    range_m = np.asarray(Image.open(file)).astype(np.float32).T / 500.0  # [columns x rows]
    model = karlsruhe_model()
    xyz = model.directions().astype(np.float32) * range_m[..., None]
    return RingedSweep(PointCloud(xyz[range_m > 0]), np.nonzero(range_m)[1])


if __name__ == '__main__':
    sys.exit(command_line.run(_command))
