"""Runs of submaps that place recognition is judged on, and their embeddings by every method."""

import os
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from lcd_common.errors import DataError
from uncertain_place_recognition.datasets.recorded import (
    TEST_SEEDS,
    VALIDATION_SEEDS,
    run_of_drive,
    simulated_drive,
)
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.run_inputs import ROLES, load_embedded, load_ensembles
from uncertain_place_recognition.submap import SubmapMaker

ARCHITECTURES = ('minkloc3d', 'pointnetvlad')
SPACING_M = 10.0


@dataclass(frozen=True)
class TestSet:
    """Runs of simulated towns: several of each, searched in one another.

    Attributes:
        seeds: of the towns.
        runs: of each town: other traffic, lanes, leaves and noise.
        length_m: of a run.
        style, lidar: of the simulator.
    """

    seeds: tuple[int, ...]
    runs: int = 3
    length_m: float = 5000.0
    style: str = ''
    lidar: str = 'hdl64'


# Towns of the frozen test split; a set changes one thing each.
SETS = {
    'town': TestSet(tuple(TEST_SEEDS[:2])),
    'town_far': TestSet(tuple(TEST_SEEDS[2:4]), style='industrial'),
    'sensor': TestSet(tuple(TEST_SEEDS[4:6]), lidar='vlp16'),
    'aliased': TestSet(tuple(TEST_SEEDS[6:8]), style='aliased'),
}
# Sixty runs: with a third of them for thresholds, promises by run can be kept at 5 %.
CALIBRATION = TestSet(tuple(VALIDATION_SEEDS), runs=6, length_m=1000.0)


def shortened(chosen: TestSet) -> TestSet:
    """Return a set for --quick: one town, runs of 1 km."""
    return TestSet(chosen.seeds[:1], 3, min(chosen.length_m, 1000.0), chosen.style, chosen.lidar)


def weights(architecture: str) -> dict[str, Path]:
    """Return weights by role: $PLACE_WEIGHTS/<architecture>/<role>, folders or .safetensors files.

    Raises:
        DataError: there are none.
    """
    named = os.environ.get('PLACE_WEIGHTS')
    if not named:
        raise DataError(
            'set PLACE_WEIGHTS to a folder with weights, <architecture>/<role> each: '
            f'{", ".join(ARCHITECTURES)}; {", ".join(ROLES)}'
        )
    folder = Path(named) / architecture
    found = {}
    for role in ROLES:
        for path in (folder / role, folder / f'{role}.safetensors'):
            if path.exists():
                found[role] = path
    if not found:
        raise DataError(f'{folder}: expected weights {", ".join(ROLES)} in it')
    return found


def trained_for(architecture: str) -> list[tuple[int, str]]:
    """Return of how many batches there are students, and the name that `weights` knows them by.

    They are in $PLACE_WEIGHTS/<architecture>/epochs/<batches>/students.
    """
    folder = f'{architecture}/epochs'
    named = Path(os.environ.get('PLACE_WEIGHTS', '')) / folder
    counts = sorted(int(path.name) for path in named.glob('*') if path.name.isdecimal())
    if not counts:
        raise DataError(f'{named}: expected a folder for each number of batches, e.g. 800/students')
    return [(count, f'{folder}/{count}') for count in counts]


def embedded(
    name: str, chosen: TestSet, architecture: str, work: Path, roles: tuple[str, ...] = ROLES
) -> list[EmbeddedRun]:
    """Return the embedded runs of a set; what is in the work folder is not made again.

    Args:
        name: of the set.
        chosen: its runs.
        architecture: whose weights.
        work: folder for runs (work/runs/<set>_<length>m) and embeddings (work/embedded/...);
            either may be filled beforehand, on a machine with a GPU.
        roles: of the ensembles that embed.
    """
    folder = f'{name}_{chosen.length_m:.0f}m'
    kept = work / 'embedded' / architecture / folder
    names = [f'{town_name(chosen, seed)}_run{run}' for seed, run in _drives(chosen)]
    files = [kept / f'{one}.npz' for one in names]
    if all(file.is_file() for file in files):
        runs = [EmbeddedRun.load(file) for file in files]
        known = weights(architecture) if os.environ.get('PLACE_WEIGHTS') else {}
        if known.keys() & set(roles) <= runs[0].members.keys():
            return runs  # nothing would be added
    found = {role: path for role, path in weights(architecture).items() if role in roles}
    ensembles = load_ensembles([f'{role}={path}' for role, path in found.items()], 'cpu')
    if not ensembles:
        raise DataError(f'{architecture} has none of the ensembles {", ".join(roles)}')
    maker = SubmapMaker(next(iter(ensembles.values())).submap)
    made = []
    for one, (seed, run) in zip(names, tqdm(_drives(chosen), f'runs of {name}'), strict=True):
        path = work / 'runs' / folder / f'{one}.npz'
        made.append(path)
        if not path.is_file():
            drive = simulated_drive(
                seed, run, style=chosen.style, lidar=chosen.lidar, length_m=chosen.length_m
            )
            world = town_name(chosen, seed)
            run_of_drive(drive, maker, spacing_m=SPACING_M, world=world).save(path)
    return load_embedded(made, ensembles, kept)


def town_name(chosen: TestSet, seed: int) -> str:
    """Return the name of a set's town."""
    return '_'.join(filter(None, (f'town_{seed}', chosen.style, chosen.lidar)))


def _drives(chosen: TestSet) -> list[tuple[int, int]]:
    return [(seed, run) for seed in chosen.seeds for run in range(chosen.runs)]
