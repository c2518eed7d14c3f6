"""Make runs of any drive that the suite reads: bags, KITTI, MulRan, the simulator."""

import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from lcd_common.errors import ConfigError
from uncertain_place_recognition.runs import Progress, SubmapRun, run_of_sweeps
from uncertain_place_recognition.submap import SubmapMaker

if TYPE_CHECKING:
    from bags.records import Drive

TRAIN_SEEDS, VALIDATION_SEEDS, TEST_SEEDS = range(100), range(100, 110), range(200, 210)
_TOWN = re.compile(r'^town_\d+(?:_(?:urban|residential|avenue|industrial|open|aliased))?(?=_|$)')


def world_of(name: str) -> str:
    """Return the world that a drive's poses lie in, by its name.

    Drives of one simulated town share it (`town_3_run1` and `town_3_reverse_run0` are town_3's);
    any other drive is a world of its own.
    """
    town = _TOWN.match(name)
    return town.group(0) if town else name


def run_of_drive(
    drive: 'Drive',
    maker: SubmapMaker,
    *,
    spacing_m: float = 2.0,
    world: str = '',
    progress: Progress = lambda done, total: None,
) -> SubmapRun:
    """Return a run of a drive with ground truth.

    Args:
        drive: any of `bags`.
        maker: of submaps.
        spacing_m: path between two submaps at least.
        world: of the poses; empty: `world_of` the drive's name.
        progress: told how many sweeps are done of how many there are.

    Raises:
        DataError: the drive has no truth, or no sweep has a pose and enough points.
    """
    from lcd_loop_closure.evaluation.drive_sweeps import store_drive

    with TemporaryDirectory(prefix='sweeps_') as folder:
        sweeps = store_drive(drive, Path(folder), spacing_m=spacing_m, progress=progress)
        return run_of_sweeps(sweeps, maker.make, world or world_of(drive.name))


def simulated_drive(
    seed: int,
    run: int = 0,
    *,
    style: str = '',
    lidar: str = 'hdl64',
    length_m: float = 1500.0,
    same_way: float = 0.2,
    reverse: float = 0.1,
) -> 'Drive':
    """Return a drive through a simulated town, cast when it is read.

    Args:
        seed: of the town: 0-99 for training, 100-109 for validation, from 200 on for tests.
        run: another time on the same streets, with other cars, leaves, lanes and noise.
        style: one of bags.simulation.streetscape.STREETSCAPES; empty: a mixture.
        lidar: one of bags.simulation.lidar_model.LIDARS.
        length_m: of the drive.
        same_way, reverse: shares of it on streets driven before.

    Raises:
        ConfigError: there is no style or LiDAR of that name.
    """
    from bags.simulation.drive import SensorsConfig, SimulatedDrive
    from bags.simulation.itinerary import JourneyConfig
    from bags.simulation.streetscape import STREETSCAPES
    from bags.simulation.town import SimulatedTown

    if style and style not in STREETSCAPES:
        raise ConfigError(f'no town style {style!r}; there are {", ".join(sorted(STREETSCAPES))}')
    drive = SimulatedDrive(
        SimulatedTown(seed, style or None),
        run,
        JourneyConfig(length=length_m, same_way=same_way, reverse=reverse),
        SensorsConfig(lidar=lidar, imu='', gnss=False),
    )
    town = f'town_{seed}_{style}' if style else f'town_{seed}'
    drive.name = f'{town}_run{run}_{lidar}'
    return drive
