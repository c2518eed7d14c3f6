"""Trained CMRNets, and the samples and drives of towns nobody trained or chose on."""

import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tqdm import tqdm

from cmrnet_ekf.evaluation.measures import MCD_COUNTS
from cmrnet_ekf.evaluation.named_networks import named_predictors
from cmrnet_ekf.evaluation.study import MCD_SAMPLES, Study, study
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive, record
from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.pose_sampling import STAGES
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_maker import SamplesConfig, make_samples
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.towns import map_town, seen_town
from lcd_common.errors import DataError

ROLES = ('cmrnet', 'mcd', 'de', 'der')
LATER = ('second', 'third')
TOWNS = (200, 201, 202)  # of the frozen test split
LENGTH_M = 600.0
DRAWS = 4
TRACKED_TOWN, TRACKED_M = 203, 1200.0
_TILES = 2000


def predictors(
    stage: str = '', samples: int = MCD_SAMPLES, others: bool = True
) -> dict[str, Predictor]:
    """Return networks by role: $CMRNET_WEIGHTS/<role>, of later stages $CMRNET_WEIGHTS/second/...

    A role is a .safetensors file, a folder of train_cmrnet, or (an ensemble) a folder of such.
    What else lies there (other losses, say) comes behind the thesis's four, if asked for.

    Raises:
        DataError: there are none of the first stage.
    """
    named = os.environ.get('CMRNET_WEIGHTS')
    if not named:
        raise DataError(
            f'set CMRNET_WEIGHTS to a folder with trained networks, one each: {", ".join(ROLES)}'
        )
    folder = Path(named) / stage
    there = sorted(folder.iterdir()) if folder.is_dir() else []
    paths = {
        path.stem: path
        for path in there
        if path.suffix == '.safetensors' or (path.is_dir() and path.name not in LATER)
    }
    if not stage and not paths.keys() & set(ROLES):
        raise DataError(f'{folder}: expected {", ".join(ROLES)} in it, or some of them')
    rest = [role for role in paths if role not in ROLES] if others else []
    wanted = [role for role in (*ROLES, *rest) if role in paths]
    return named_predictors([f'{role}={paths[role]}' for role in wanted], samples=samples)


@cache
def judged(work: Path, quick: bool = False) -> Study:
    """Return what all networks say of the test samples; samples in the work folder stay."""
    first = predictors(samples=max(MCD_COUNTS))
    later = [found for found in (predictors(stage) for stage in LATER) if found]
    network = next(iter(first.values())).settings
    sets = list(samples(work, network, TOWNS[:1] if quick else TOWNS, 100.0 if quick else LENGTH_M))
    total = sum(map(len, sets)) * (len(first) + (len(later[0]) if later else 0))
    with tqdm(total=total, unit='sample', desc='networks') as bar:
        return study(first, sets, later, progress=bar.update)


def samples(
    work: Path, network: CmrnetConfig, towns: tuple[int, ...], length_m: float
) -> Iterator[SampleSet]:
    """Yield the samples of towns, made when they are not there."""
    for town in towns:
        name = f'town_{town}_{length_m:.0f}m'
        out = work / 'samples' / name
        if not (out / 'facts.json').is_file():
            drive = seen_town(town, length_m)
            local_map = town_map(work, town, length_m)
            with tqdm(unit='frame', desc=name) as bar:
                make_samples(
                    out, drive, drive.truth(), local_map, network, STAGES[0],
                    SamplesConfig(draws=DRAWS), bar.update,
                )  # fmt: skip
        yield SampleSet(out)


def tracked(
    work: Path, network: CmrnetConfig, town: int, length_m: float
) -> tuple[TrackingDrive, LocalMap]:
    """Return a drive that is tracked, rendered once, and its map."""
    drive = seen_town(town, length_m, imu='rt3003')
    local_map = town_map(work, town, length_m)
    name = f'town_{town}_{length_m:.0f}m'
    with tqdm(unit='image', desc=f'frames of {name}') as bar:
        recorded = record(
            work / 'tracked' / name, drive, drive.truth(), network, progress=bar.update
        )
    return recorded, local_map


def town_map(work: Path, town: int, length_m: float) -> LocalMap:
    """Return the map of a town's first run, made when it is not there."""
    path = work / 'maps' / f'town_{town}_{length_m:.0f}m'
    map_town(path, town, length_m, MapConfig(), every=2)
    return LocalMap(path, LocalMapConfig(kept_tiles=_TILES))
