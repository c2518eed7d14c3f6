"""Draw what a drive gave. Every function draws on the axes it is given; metres, equal scales."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.evaluation import TrajectoryErrors
from lcd_loop_closure.report.loop_evaluation import JudgedLoop, Verdict

# Okabe and Ito's palette: told apart by colour-blind readers and in print.
BEFORE, AFTER, TRUTH = '#999999', '#0072B2', '#222222'
LOOP_COLOURS = {
    Verdict.TRUE: '#009E73',
    Verdict.UNKNOWN: '#009E73',
    Verdict.FALSE: '#D55E00',
}
MISSED = '#E69F00'
NODE_COLOURS = ('#56B4E9', '#009E73', '#CC79A7', '#F0E442')
STYLE = {
    'font.size': 10,
    'axes.titlesize': 11,
    'axes.titlelocation': 'left',
    'axes.titleweight': 'bold',
    'axes.spines.top': False,
    'axes.spines.right': False,
    'axes.grid': True,
    'axes.axisbelow': True,
    'grid.color': '#e6e6e6',
    'grid.linewidth': 0.6,
    'legend.frameon': False,
    'lines.solid_capstyle': 'round',
}


def draw_trajectories(
    ax: Axes, before: Trajectory, after: Trajectory, truth_in_map: Trajectory | None
) -> None:
    """Draw odometry, the corrected trajectory and the reference from above."""
    if truth_in_map is not None:
        _line(ax, truth_in_map, color=TRUTH, lw=0.9, ls=(0, (5, 5)), label='reference', zorder=4)
    _line(ax, before, color=BEFORE, lw=1.3, label='odometry alone')
    _line(ax, after, color=AFTER, lw=2.4, label='corrected', zorder=3)
    start = after.positions[0]
    ax.plot(
        *start[:2],
        marker='o',
        ms=7,
        mfc='white',
        mec=AFTER,
        mew=1.8,
        ls='',
        label='start',
        zorder=6,
    )
    _metres(ax)


def draw_loops(
    ax: Axes, after: Trajectory, judged: Sequence[JudgedLoop], missed_ns: NDArray[np.int64]
) -> None:
    """Draw accepted loops between their keyframes, and the keyframes that should have had one."""
    missed = _positions(after, missed_ns)
    if len(missed):
        ax.plot(
            missed[:, 0],
            missed[:, 1],
            ls='',
            marker='o',
            ms=5.5,
            mfc='none',
            mec=MISSED,
            mew=1.2,
            label=f'no loop found here ({len(missed)})',
            zorder=4,
        )
    for verdict, name in _loop_names(judged):
        segments = _segments(after, judged, verdict)
        if not segments:
            continue
        colour = LOOP_COLOURS[verdict]
        ax.add_collection(LineCollection(segments, colors=colour, lw=1.1, alpha=0.9, zorder=5))
        ends = np.array([segment[1] for segment in segments])
        # A dot at the later keyframe: most loops are shorter than the line is wide.
        marker = 'X' if verdict is Verdict.FALSE else 'o'
        ax.plot(
            ends[:, 0],
            ends[:, 1],
            ls='',
            marker=marker,
            ms=8 if marker == 'X' else 5,
            mec='white',
            mew=0.6,
            color=colour,
            label=f'{name} ({len(segments)})',
            zorder=7 if marker == 'X' else 5,
        )


def draw_loops_over_time(ax: Axes, after: Trajectory, judged: Sequence[JudgedLoop]) -> None:
    """Draw the trajectory with time as its height (a 3D axis), so that every loop is a bridge."""
    seconds = (after.stamps_ns - after.stamps_ns[0]) * 1e-9
    x, y = after.positions[:, 0], after.positions[:, 1]
    ax.plot(x, y, np.zeros_like(x), color='#dddddd', lw=1.0)
    ax.plot(x, y, seconds, color=AFTER, lw=1.4)
    for verdict, name in _loop_names(judged):
        label: str | None = name
        for j in judged:
            if j.verdict is not verdict:
                continue
            stamps = np.array([j.loop.match_stamp_ns, j.loop.query_stamp_ns])
            ends = _positions(after, stamps)
            if len(ends) == 2:
                height = (stamps - after.stamps_ns[0]) * 1e-9
                width = 1.6 if verdict is Verdict.FALSE else 0.7
                ax.plot(
                    ends[:, 0],
                    ends[:, 1],
                    height,
                    color=LOOP_COLOURS[verdict],
                    lw=width,
                    alpha=0.7,
                    label=label,
                )
                label = None
    spans = [max(float(np.ptp(x)), 1.0), max(float(np.ptp(y)), 1.0)]
    longest = max(spans)
    ax.set_box_aspect(
        (max(spans[0] / longest, 0.35), max(spans[1] / longest, 0.35), 0.55), zoom=1.15
    )
    ax.set_xlabel('x [m]')
    ax.set_ylabel('y [m]')
    ax.set_zlabel('time [s]')
    ax.view_init(elev=24, azim=-60)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.pane.set_visible(False)
        axis.set_major_locator(_few_ticks())


def draw_errors(ax: Axes, before: TrajectoryErrors, after: TrajectoryErrors) -> None:
    """Draw the aligned position error over time, before and after."""
    for errors, colour, name in ((before, BEFORE, 'odometry alone'), (after, AFTER, 'corrected')):
        seconds = (errors.stamps_ns - before.stamps_ns[0]) * 1e-9
        rmse = float(np.sqrt(np.mean(errors.errors_m**2)))
        ax.fill_between(seconds, errors.errors_m, color=colour, alpha=0.12, lw=0)
        ax.plot(seconds, errors.errors_m, color=colour, lw=1.5, label=f'{name}: RMSE {rmse:.3g} m')
    ax.set_xlim(0, (before.stamps_ns[-1] - before.stamps_ns[0]) * 1e-9)
    ax.set_ylim(0, None)
    ax.set_xlabel('time [s]')
    ax.set_ylabel('position error [m]')


def draw_stage_times(
    ax: Axes, stage_times_ms: Mapping[str, Mapping[str, list[float]]], period_ms: float | None
) -> None:
    """Draw how long every stage of every node takes: half of its runs in the box, 98 % in whiskers.

    Args:
        ax: axes to draw on.
        stage_times_ms: node -> stage -> milliseconds.
        period_ms: time between two scans, drawn as the budget; None leaves it out.
    """
    rows = [
        (node, stage, times)
        for node, stages in stage_times_ms.items()
        for stage, times in stages.items()
        if len(times)
    ]
    nodes = list(dict.fromkeys(node for node, _, _ in rows))
    colour = {node: NODE_COLOURS[k % len(NODE_COLOURS)] for k, node in enumerate(nodes)}
    rows = rows[::-1]
    boxes = ax.boxplot(
        # A logarithmic axis has no zero: nothing is drawn below a microsecond.
        [np.maximum(times, 1e-3) for _, _, times in rows],
        orientation='horizontal',
        whis=(1, 99),
        showfliers=False,
        patch_artist=True,
        widths=0.6,
        medianprops={'color': '#222222', 'lw': 1.4},
        whiskerprops={'color': '#777777'},
        capprops={'color': '#777777'},
    )
    for box, (node, _, _) in zip(boxes['boxes'], rows, strict=True):
        box.set(facecolor=colour[node], edgecolor='none')
    ax.set_yticks(range(1, len(rows) + 1), [stage for _, stage, _ in rows])
    ax.grid(axis='y', visible=False)
    ax.tick_params(axis='y', length=0)
    ax.set_xscale('log')
    ax.xaxis.set_major_formatter(lambda value, _: f'{value:g}')
    ax.set_xlabel('time [ms], logarithmic')
    handles: list[object] = [Patch(facecolor=colour[node], label=node.strip('/')) for node in nodes]
    if period_ms is not None:
        handles.append(
            ax.axvline(period_ms, color='#222222', lw=1, ls=':', label='time between scans')
        )
    legend_below(ax, handles=handles)


def draw_map(
    ax: Axes, cloud: PointCloud, trajectory: Trajectory | None = None, pixels: int = 900
) -> AxesImage:
    """Draw a map from above, coloured by height.

    Args:
        ax: axes to draw on.
        cloud: in the map frame.
        trajectory: drawn on top; None leaves it out.
        pixels: at most, along the longer side; every one shows its highest point.

    Returns:
        The image, for a colour bar.
    """
    # A handful of far points would shrink everything else.
    corners = np.percentile(cloud.xyz[:, :2], [0.1, 99.9], axis=0)
    xyz = cloud.xyz[((cloud.xyz[:, :2] >= corners[0]) & (cloud.xyz[:, :2] <= corners[1])).all(1)]
    left, bottom = corners[0]
    width, height = np.maximum(corners[1] - corners[0], 1.0)
    # Pixels finer than the map's own voxels would leave gaps between its points.
    cell = max(max(width, height) / pixels, 2.0 * _spacing(xyz[:, :2]))
    rows, columns = int(height / cell) + 1, int(width / cell) + 1
    pixel = ((xyz[:, 1] - bottom) / cell).astype(np.int64) * columns + (
        (xyz[:, 0] - left) / cell
    ).astype(np.int64)
    highest = np.full(rows * columns, -np.inf, np.float32)
    np.maximum.at(highest, pixel, xyz[:, 2])
    image = np.where(np.isfinite(highest), highest, np.nan).reshape(rows, columns)
    low, high = np.percentile(xyz[:, 2], [3, 97])
    drawn = ax.imshow(
        image,
        origin='lower',
        extent=(left, left + columns * cell, bottom, bottom + rows * cell),
        cmap='viridis',
        vmin=low,
        vmax=max(high, low + 0.5),
        interpolation='nearest',
    )
    if trajectory is not None:
        _line(ax, trajectory, color='white', lw=2.6, alpha=0.9)
        _line(ax, trajectory, color='#D55E00', lw=1.2, label='corrected trajectory')
    ax.grid(visible=False)
    _metres(ax, adjustable='box')
    return drawn


def legend_below(ax: Axes, handles: Sequence[object] | None = None, columns: int = 4) -> None:
    """Put the legend under the figure, where no data lies (needs the constrained layout)."""
    given = ax.get_legend_handles_labels()[0] if handles is None else list(handles)
    if given:
        ax.figure.legend(
            handles=given,
            loc='outside lower center',
            ncols=min(columns, len(given)),
            columnspacing=1.6,
            handlelength=1.8,
        )


def _spacing(xy: NDArray[np.floating]) -> float:
    """Return the median distance of a point to its neighbour, metres."""
    if len(xy) < 2:
        return 1.0
    sample = xy[:: max(len(xy) // 2000, 1)]
    away, _ = cKDTree(xy).query(sample, k=2)
    return float(np.median(away[:, 1]))


def _line(ax: Axes, trajectory: Trajectory, **style: object) -> None:
    ax.plot(trajectory.positions[:, 0], trajectory.positions[:, 1], **style)


def _metres(ax: Axes, adjustable: str = 'datalim') -> None:
    ax.set_aspect('equal', adjustable=adjustable)
    ax.set_xlabel('x [m]')
    ax.set_ylabel('y [m]')


def _few_ticks() -> object:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4)


def _loop_names(judged: Sequence[JudgedLoop]) -> list[tuple[Verdict, str]]:
    names = {
        Verdict.UNKNOWN: 'accepted loop',
        Verdict.TRUE: 'true loop',
        Verdict.FALSE: 'false loop',
    }
    present = {j.verdict for j in judged}
    return [(verdict, name) for verdict, name in names.items() if verdict in present]


def _positions(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> se3.Array:
    poses = [trajectory.at(int(stamp)) for stamp in stamps_ns]
    return np.array([T[:3, 3] for T in poses if T is not None]).reshape(-1, 3)


def _segments(
    trajectory: Trajectory, judged: Sequence[JudgedLoop], verdict: Verdict
) -> list[NDArray[np.float64]]:
    segments = []
    for j in judged:
        if j.verdict is verdict:
            ends = _positions(trajectory, np.array([j.loop.match_stamp_ns, j.loop.query_stamp_ns]))
            if len(ends) == 2:
                segments.append(ends[:, :2])
    return segments
