"""Make the pictures of a drive and write them as PNG."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report import plots
from lcd_loop_closure.report.drive_evaluation import DriveEvaluation
from lcd_loop_closure.report.result import DriveResult

_DPI = 130


@dataclass(frozen=True)
class Picture:
    """One picture of the report: its file, a title, and one sentence that says what it shows."""

    path: Path
    title: str
    caption: str


def write_pictures(
    result: DriveResult, evaluation: DriveEvaluation, folder: Path
) -> tuple[Picture, ...]:
    """Draw everything that the drive allows into `folder`, and return it in reading order."""
    folder.mkdir(parents=True, exist_ok=True)
    makers = (_trajectory, _errors, _map, _loops_over_time, _stage_times)
    pictures = (make(result, evaluation, folder) for make in makers)
    return tuple(picture for picture in pictures if picture is not None)


def write_overview(result: DriveResult, evaluation: DriveEvaluation, path: Path) -> None:
    """Draw map and trajectories side by side into one PNG, the picture of a README."""
    with _figure(path, (11.5, 5.2)) as figure:
        left, right = figure.subplots(1, 2)
        figure.get_layout_engine().set(rect=(0.0, 0.0, 0.985, 1.0))  # room for the last tick label
        if result.map_cloud is not None and len(result.map_cloud):
            drawn = plots.draw_map(left, result.map_cloud, pixels=420)
            figure.colorbar(drawn, ax=left, label='height [m]', shrink=0.6, pad=0.02)
        left.set_title('Map')
        _draw_trajectory(right, result, evaluation)
        right.set_title('Trajectory and loops')


def _trajectory(result: DriveResult, evaluation: DriveEvaluation, folder: Path) -> Picture:
    path = folder / 'trajectory.png'
    with _figure(path, _size(evaluation.corrected)) as figure:
        _draw_trajectory(figure.subplots(), result, evaluation)
    judged = 'green where right, red where wrong' if evaluation.loops else 'in green'
    return Picture(
        path,
        'Trajectory',
        'The drive from above: odometry alone in grey, corrected by the loops in blue'
        + (', the reference dashed' if evaluation.truth_in_map is not None else '')
        + f'; accepted loops {judged}'
        + (', orange rings where a revisit got none.' if len(evaluation.missed_stamps_ns) else '.'),
    )


def _draw_trajectory(ax: mpl.axes.Axes, result: DriveResult, evaluation: DriveEvaluation) -> None:
    plots.draw_trajectories(ax, result.odometry, evaluation.corrected, evaluation.truth_in_map)
    plots.draw_loops(ax, evaluation.corrected, evaluation.judged, evaluation.missed_stamps_ns)
    plots.legend_below(ax, columns=3)


def _errors(result: DriveResult, evaluation: DriveEvaluation, folder: Path) -> Picture | None:
    if evaluation.before is None or evaluation.after is None:
        return None
    path = folder / 'error_over_time.png'
    with _figure(path, (9.0, 3.6)) as figure:
        ax = figure.subplots()
        plots.draw_errors(ax, evaluation.before, evaluation.after)
        plots.legend_below(ax)
    return Picture(
        path,
        'Error over time',
        'Distance to the reference at every scan, each trajectory laid on it as well as a rigid '
        'motion can.',
    )


def _map(result: DriveResult, evaluation: DriveEvaluation, folder: Path) -> Picture | None:
    if result.map_cloud is None or not len(result.map_cloud):
        return None
    path = folder / 'map.png'
    with _figure(path, _size(evaluation.corrected, margin_m=60.0)) as figure:
        ax = figure.subplots()
        drawn = plots.draw_map(ax, result.map_cloud, evaluation.corrected)
        figure.colorbar(drawn, ax=ax, label='height [m]', shrink=0.7, pad=0.02)
    return Picture(
        path,
        'Map',
        f'The corrected map from above ({len(result.map_cloud):,} points), coloured by height, '
        'with the corrected trajectory; a wall that appears twice is a loop missed or wrong.',
    )


def _loops_over_time(
    result: DriveResult, evaluation: DriveEvaluation, folder: Path
) -> Picture | None:
    if not result.accepted:
        return None
    path = folder / 'loops_over_time.png'
    with _figure(path, (8.4, 6.2)) as figure:
        ax = figure.add_subplot(projection='3d')
        plots.draw_loops_over_time(ax, evaluation.corrected, evaluation.judged)
        ax.legend(loc='upper right', bbox_to_anchor=(1.0, 0.95))
    return Picture(
        path,
        'Loops over time',
        'The same drive with time as its height: every bridge is a loop between a visit and '
        'a later one (not to scale).',
    )


def _stage_times(result: DriveResult, evaluation: DriveEvaluation, folder: Path) -> Picture | None:
    rows = sum(1 for stages in result.stage_times_ms.values() for times in stages.values() if times)
    if not rows:
        return None
    path = folder / 'stage_times.png'
    period_ms = None
    if len(result.odometry) > 1:
        period_ms = float(np.median(np.diff(result.odometry.stamps_ns))) * 1e-6
    with _figure(path, (9.0, 1.6 + 0.34 * rows)) as figure:
        plots.draw_stage_times(figure.subplots(), result.stage_times_ms, period_ms)
    return Picture(
        path,
        'Time per stage',
        'How long each stage of each node took: half of its runs lie in the box, 98 % within the '
        'whiskers, the line is the median; the dotted line is the time between two scans.',
    )


@contextmanager
def _figure(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure in the suite's style and write it; no global state, no display."""
    with mpl.rc_context(plots.STYLE):
        figure = Figure(figsize=size, dpi=_DPI, layout='constrained')
        FigureCanvasAgg(figure)
        yield figure
        figure.savefig(path, facecolor='white')


def _size(trajectory: Trajectory, margin_m: float = 10.0) -> tuple[float, float]:
    """Choose a figure that fits the drive's extent, within what a page can show."""
    width, height = np.ptp(trajectory.positions[:, :2], axis=0) + margin_m
    return 9.0, float(np.clip(9.0 * height / width, 3.0, 8.5)) + 0.9
