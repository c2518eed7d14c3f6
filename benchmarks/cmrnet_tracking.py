"""Closed loop on a simulated drive: what filters make of each network (Tables 5.5 and 5.6)."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.cmrnet_sets import LATER, predictors, tracked
from benchmarks.ekf_consistency import TRACKS
from cmrnet_ekf.evaluation.track import write_tracks
from cmrnet_ekf.evaluation.tracking import THESIS, VEHICLE, Track
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive
from cmrnet_ekf.evaluation.tracking_filters import VehicleTrackingConfig
from cmrnet_ekf.evaluation.tracking_study import Way, draw, figures_of, markdown, tracks, ways
from cmrnet_ekf.mapping.local_map import LocalMap

# DER runs often: its promise is that it never diverges.
RUNS, RUNS_DER = 3, 20
PARTS = ('vehicle', 'thesis', 'refined')


def evaluate(work: Path, quick: bool = False) -> dict[str, Any]:
    """Track with each way from wrong start poses, part by part.

    vehicle: the vehicle's EKF with the networks of the first stage; thesis: the thesis's filter
    with the same; refined: the vehicle's with all stages.
    """
    found = part(work, 'vehicle', quick)
    for name in PARTS[1:]:
        if figures := part(work, name, quick):
            found[name] = figures
    return found


def part(work: Path, name: str, quick: bool = False) -> dict[str, Any]:
    """Return the figures of one of PARTS; none of `refined` where no later stage is trained."""
    found = {role: [one] for role, one in predictors(others=False).items()}
    drive, local_map = tracked(work, next(iter(found.values()))[0].settings, quick)
    if name == 'refined':
        for stage in LATER:
            for role, one in predictors(stage, others=False).items():
                found[role].append(one)
        found = {role: stages for role, stages in found.items() if len(stages) > 1}
    by = THESIS if name == 'thesis' else VEHICLE
    # The rows without a network that knows are the same in all parts.
    chosen = {
        way: how
        for way, how in ways(found, by).items()
        if name == 'vehicle' or (how.stages and (how.by == by or name == 'refined'))
    }
    picture = 'heat' if name == 'vehicle' else f'heat_{name}'
    figures = _run(drive, local_map, chosen, work, picture, quick)
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


def _run(
    drive: TrackingDrive,
    local_map: LocalMap,
    chosen: Mapping[str, Way],
    work: Path,
    name: str,
    quick: bool,
) -> dict[str, Any]:
    if not chosen:
        return {}
    runs = {way: 1 if quick else RUNS_DER if way == 'der' else RUNS for way in chosen}
    found: dict[str, list[Track]] = defaultdict(list)
    with tqdm(total=sum(runs.values()) * (len(drive) - 1), unit='image', desc='tracking') as bar:
        for way, one in tracks(drive, local_map, chosen, runs, progress=bar.update):
            found[way].append(one)
    folder = work / 'pictures' / 'cmrnet'
    draw(drive, found, folder / f'{name}.png')
    figures = {way: figures_of(of_way) for way, of_way in found.items()}
    (folder / f'{name}.md').write_text(markdown(figures, drive.name))
    write_tracks(found, work / TRACKS.replace('heat', name))
    return figures
