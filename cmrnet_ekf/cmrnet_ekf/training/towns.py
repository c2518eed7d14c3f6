"""Simulated towns: mapped on one run, seen by a camera on another with other cars, light, lanes."""

from pathlib import Path

from tqdm import tqdm

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig
from cmrnet_ekf.mapping.build import drive_sweeps
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder

_DONE = 'done'  # a file that says that the map is whole


def seen_town(number: int, length_m: float, imu: str = '') -> SimulatedDrive:
    """Return the drive with a camera; `imu` as in SensorsConfig."""
    sensors = SensorsConfig(camera=True, gnss=False, imu=imu)
    return SimulatedDrive(number, 1, JourneyConfig(length=length_m), sensors)


def map_town(
    path: Path, number: int, length_m: float, settings: MapConfig, every: int, quiet: bool = False
) -> None:
    """Map a town from each `every`-th sweep of its first run; a whole map is left as it is."""
    if (path / _DONE).is_file():
        return
    builder = MapBuilder(TileFolder.create(path, settings), settings)
    sensors = SensorsConfig(gnss=False, imu='')
    mapped = SimulatedDrive(number, 0, JourneyConfig(length=length_m), sensors)
    sweeps = drive_sweeps(mapped, mapped.truth(), every=every, labels='')
    total = len(mapped.truth()) // every
    for sweep in tqdm(sweeps, f'map of town {number}', total, disable=quiet):
        builder.add(sweep.cloud, sweep.T_map_base, sweep.T_base_sensor, sweep.moving)
    builder.finish()
    (path / _DONE).touch()
