"""Compare ways of tracking on one drive: Tables 5.5 and 5.6, Fig. 5.7."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmrnet_ekf.evaluation.figure import panels
from cmrnet_ekf.evaluation.tables import table
from cmrnet_ekf.evaluation.tracking import (
    THESIS,
    UNFILTERED,
    VEHICLE,
    Track,
    TrackingConfig,
    track,
)
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive
from cmrnet_ekf.evaluation.tracking_filters import VehicleTrackingConfig
from cmrnet_ekf.mapping.local_map import LocalMap
from cmrnet_ekf.predictors import Predictor

MOTION, INERTIAL = 'motion', 'inertial'
_HOT_M = 2.0  # colours end there
_COLUMNS = (
    ('t_max_m', 't max [m]', 2), ('t_mean_m', 't mean', 2), ('t_std_m', 't std', 2),
    ('t_median_m', 't median', 2), ('r_max_deg', 'r max [°]', 1), ('r_mean_deg', 'r mean', 2),
    ('r_median_deg', 'r median', 2), ('nees_mean', 'NEES', 1), ('runs', 'runs', 0),
    ('diverged', 'diverged', 0), ('skipped_share', 'not seen', 3),
)  # fmt: skip


@dataclass(frozen=True)
class Way:
    """A way of tracking: networks, one after the other, and the filter that weighs them, if any."""

    stages: tuple[Predictor, ...] = ()
    by: str = THESIS


def ways(networks: Mapping[str, Sequence[Predictor]], by: str) -> dict[str, Way]:
    """Return the rows of the tables.

    The thesis's motion model alone; the vehicle's EKF without a camera, if that is the filter; the
    motion model corrected by the first network that does not know how sure it is; the filter with
    each of the others.
    """
    found = {MOTION: Way()}
    if by == VEHICLE:
        found[INERTIAL] = Way(by=VEHICLE)
    for name, stages in networks.items():
        if stages[-1].kind != 'plain':
            found[name] = Way(tuple(stages), by)
        elif UNFILTERED not in found:
            found[UNFILTERED] = Way(tuple(stages), UNFILTERED)
    return found


def tracks(
    drive: TrackingDrive,
    local_map: LocalMap,
    chosen: Mapping[str, Way],
    runs: Mapping[str, int],
    settings: TrackingConfig | None = None,
    told: VehicleTrackingConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Iterator[tuple[str, Track]]:
    """Drive by each way, with seeds 0, 1, ... up to its number of runs; yield each at its end."""
    for name, way in chosen.items():
        for seed in range(runs[name]):
            yield (
                name,
                track(
                    drive, local_map, way.stages, seed, by=way.by, settings=settings, told=told,
                    progress=progress,
                ),
            )  # fmt: skip


def figures_of(found: Sequence[Track]) -> dict[str, Any]:
    """Return the errors of all images of all runs of one way; nothing is left out."""
    metres = np.concatenate([one.metres for one in found])
    degrees = np.rad2deg(np.concatenate([one.radians for one in found]))
    return {
        't_max_m': float(metres.max()),
        't_mean_m': float(metres.mean()),
        't_std_m': float(metres.std()),
        't_median_m': float(np.median(metres)),
        'r_max_deg': float(degrees.max()),
        'r_mean_deg': float(degrees.mean()),
        'r_std_deg': float(degrees.std()),
        'r_median_deg': float(np.median(degrees)),
        'nees_mean': float(np.mean([one.nees.mean() for one in found])),
        'runs': len(found),
        'diverged': sum(one.diverged for one in found),
        'skipped_share': sum(one.skipped for one in found) / len(metres),
    }


def markdown(figures: Mapping[str, Mapping[str, Any]], about: str) -> str:
    """Return the table, and one sentence on what it is of."""
    rows = [[name, *(f'{f[key]:.{d}f}' for key, _, d in _COLUMNS)] for name, f in figures.items()]
    return f'{about}\n\n' + table(['', *(label for _, label, _ in _COLUMNS)], rows)


def draw(drive: TrackingDrive, found: Mapping[str, Sequence[Track]], path: Path) -> Path:
    """Draw where each way errs along the drive, in its first run (Fig. 5.7)."""
    place = drive.T_map_base[1:, :2, 3]
    with panels(path, len(found), 3, (4.0, 3.8)) as (canvas, axes):
        shown = None
        for ax, (name, of_way) in zip(axes, found.items(), strict=True):
            first = of_way[0]
            shown = ax.scatter(*place.T, c=first.metres, s=7, cmap='inferno_r', vmin=0, vmax=_HOT_M)
            ax.set_aspect('equal', 'datalim')
            ax.set_title(f'{name}: median {np.median(first.metres):.2f} m')
            ax.set(xlabel='x [m]', ylabel='y [m]')
        if shown is not None:
            canvas.colorbar(shown, ax=axes, label='translation error [m]', extend='max')
    return path
