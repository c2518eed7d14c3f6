"""Drives through simulated towns that the place head learns from and is chosen by."""

from collections.abc import Callable
from pathlib import Path

from lcd_loop_closure.evaluation.drive_sweeps import store_drive
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, is_stored

LENGTH_M = 1500.0
# Sweeps a few metres apart teach as much as all of them.
SPACING_M = 3.0
_SENSORS = ('hdl64', 'hdl64', 'os1_64', 'vlp16')


def simulated_drive(
    folder: Path,
    town: int,
    progress: Callable[[int, int], None] = lambda done, of: None,
    run: int = 0,
) -> StoredSweeps:
    """Return the sweeps of a drive through a town, cast the first time (needs the package bags).

    Training towns (below 100) come with several sensors, validation towns with KITTI's. Another
    run takes the same streets among other cars.
    """
    path = folder / f'drive_{town:03d}{f"_run{run}" if run else ""}'
    if not is_stored(path):
        from bags.simulation.drive import SensorsConfig, SimulatedDrive
        from bags.simulation.itinerary import JourneyConfig

        reverse = town % 5 != 4  # every fifth drive returns to places as it came
        journey = JourneyConfig(
            length=LENGTH_M,
            same_way=0.0 if reverse else 0.3,
            reverse=0.3 if reverse else 0.0,
            lateral=1.5,
        )
        lidar = _SENSORS[town // 5 % len(_SENSORS)] if town < 100 else 'hdl64'
        drive = SimulatedDrive(town, run, journey, SensorsConfig(lidar=lidar, imu='', gnss=False))
        drive.name = path.name
        store_drive(drive, path, spacing_m=SPACING_M, progress=progress)
    return StoredSweeps(path)
