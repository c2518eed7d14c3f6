"""Closed loop on a simulated drive: what filters make of each network (Tables 5.5 and 5.6)."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.cmrnet_sets import (
    LATER,
    LENGTH_M,
    TOWNS,
    TRACKED_M,
    TRACKED_TOWN,
    predictors,
    tracked,
)
from benchmarks.ekf_consistency import TRACKS
from cmrnet_ekf.evaluation.track import write_tracks
from cmrnet_ekf.evaluation.tracking import THESIS, VEHICLE, Track
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive
from cmrnet_ekf.evaluation.tracking_filters import VehicleTrackingConfig
from cmrnet_ekf.evaluation.tracking_study import Way, draw, figures_of, markdown, tracks, ways
from cmrnet_ekf.mapping.local_map import LocalMap
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.predictors import Predictor

# DER runs often: its promise is that it never diverges.
RUNS, RUNS_DER = 3, 20
PARTS = ('vehicle', 'thesis', 'refined', 'towns')


def evaluate(work: Path, quick: bool = False) -> dict[str, Any]:
    """Track with each way from wrong start poses, part by part.

    vehicle: the vehicle's EKF with the networks of the first stage; thesis: the thesis's filter
    with the same; refined: the vehicle's with all stages; towns: that on other drives.
    """
    found = part(work, 'vehicle', quick)
    for name in PARTS[1:]:
        if figures := part(work, name, quick):
            found[name] = figures
    return found


def part(work: Path, name: str, quick: bool = False) -> dict[str, Any]:
    """Return the figures of one of PARTS; none of later stages where none is trained."""
    found = {role: [one] for role, one in predictors(others=False).items()}
    first = next(iter(found.values()))[0].settings
    if name in ('refined', 'towns'):
        for stage in LATER:
            for role, one in predictors(stage, others=False).items():
                found[role].append(one)
        found = {role: stages for role, stages in found.items() if len(stages) > 1}
    if name == 'towns':
        return _towns(work, found, first, quick)
    by = THESIS if name == 'thesis' else VEHICLE
    # The rows without a network that knows are the same in all parts.
    chosen = {
        way: how
        for way, how in ways(found, by).items()
        if name == 'vehicle' or (how.stages and how.by == by)
    }
    if not chosen:
        return {}
    drive, local_map = tracked(work, first, TRACKED_TOWN, 100.0 if quick else TRACKED_M)
    runs = {way: 1 if quick else RUNS_DER if way == 'der' else RUNS for way in chosen}
    tracked_by = _run(drive, local_map, chosen, runs)
    folder = work / 'pictures' / 'cmrnet'
    picture = 'heat' if name == 'vehicle' else f'heat_{name}'
    draw(drive, tracked_by, folder / f'{picture}.png')
    figures = {way: figures_of(of_way) for way, of_way in tracked_by.items()}
    (folder / f'{picture}.md').write_text(markdown(figures, drive.name))
    write_tracks(tracked_by, work / f'{name}_tracks.npz')
    if name == 'vehicle':
        figures['conditions'] = {
            'drive': drive.name,
            'images': len(drive),
            'length_m': drive.length_m,
            'turned_by': drive.turned_by,
            'start': 'uniform within 2 m (1 m in z) and 10 degrees of each axis',
            'speed': 'truth, off by a factor of 1 +- 0.01 a run and 0.1 m/s an image',
            'told': asdict(VehicleTrackingConfig()),
        }
    return figures


def _towns(
    work: Path, found: Mapping[str, Sequence[Predictor]], first: CmrnetConfig, quick: bool
) -> dict[str, Any]:
    """Return DER in all its stages on the other test towns, of each and together."""
    if 'der' not in found:
        return {}
    chosen = {'der': Way(tuple(found['der']), VEHICLE)}
    figures: dict[str, Any] = {}
    together: list[Track] = []
    for town in TOWNS[:1] if quick else TOWNS:
        drive, local_map = tracked(work, first, town, 100.0 if quick else LENGTH_M)
        tracked_by = _run(drive, local_map, chosen, {'der': 1 if quick else RUNS})
        write_tracks(tracked_by, work / f'{drive.name}_{TRACKS}')
        figures[drive.name] = figures_of(tracked_by['der'])
        together += tracked_by['der']
    return {'der': figures_of(together), **figures}


def _run(
    drive: TrackingDrive, local_map: LocalMap, chosen: Mapping[str, Way], runs: Mapping[str, int]
) -> dict[str, list[Track]]:
    found: dict[str, list[Track]] = defaultdict(list)
    with tqdm(total=sum(runs.values()) * (len(drive) - 1), unit='image', desc='tracking') as bar:
        for way, one in tracks(drive, local_map, chosen, runs, progress=bar.update):
            found[way].append(one)
    return found
