"""Closed loop on a simulated drive: what the thesis's filter makes of each network (Table 5.5)."""

from collections import defaultdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.cmrnet_sets import LATER, predictors, tracked
from benchmarks.ekf_consistency import TRACKS
from cmrnet_ekf.evaluation.track import write_tracks
from cmrnet_ekf.evaluation.tracking import Track
from cmrnet_ekf.evaluation.tracking_study import draw, figures_of, markdown, tracks, ways
from cmrnet_ekf.predictors import Predictor

# DER runs often: its promise is that it never diverges.
RUNS, RUNS_DER = 3, 20


def evaluate(work: Path, quick: bool = False) -> dict[str, Any]:
    """Track with each way from wrong start poses; later stages refine where they are trained."""
    found: dict[str, list[Predictor]] = {
        role: [one] for role, one in predictors(others=False).items()
    }
    for stage in LATER:
        for role, one in predictors(stage, others=False).items():
            found[role].append(one)
    drive, local_map = tracked(work, next(iter(found.values()))[0].settings, quick)
    single = {role: stages[:1] for role, stages in found.items()}
    figures = _run(drive, local_map, single, work, 'heat', quick)
    figures['conditions'] = {
        'drive': drive.name,
        'images': len(drive),
        'length_m': drive.length_m,
        'turned_by': drive.turned_by,
        'start': 'uniform within 2 m (1 m in z) and 10 degrees of each axis',
        'speed': 'truth, off by a factor of 1 +- 0.01 a run and 0.1 m/s an image',
    }
    staged = {role: stages for role, stages in found.items() if len(stages) > 1}
    if staged:
        figures['refined'] = _run(drive, local_map, staged, work, 'heat_refined', quick)
    return figures


def _run(
    drive: Any,
    local_map: Any,
    networks: dict[str, list[Predictor]],
    work: Path,
    name: str,
    quick: bool,
) -> dict[str, Any]:
    chosen = ways(networks)
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
