"""Make the pictures of an evaluation and write them as PNG."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcd_common import se3
from lcd_loop_closure.evaluation import plots
from lcd_loop_closure.evaluation.detection import CLASSES
from lcd_loop_closure.evaluation.registration_errors import (
    SUCCESS_DEG,
    SUCCESS_M,
    RegistrationErrors,
)
from lcd_loop_closure.evaluation.study import JudgedMethod, Study
from lcd_loop_closure.report.plots import STYLE

_TITLES = {'all': 'all revisits', 'same_way': 'same way', 'reverse': 'reverse'}


@dataclass(frozen=True)
class Picture:
    """One picture: its file, a title, and one sentence that says what it shows."""

    path: Path
    title: str
    caption: str


def write_pictures(study: Study, T_world_base: se3.Array, folder: Path) -> list[Picture]:
    """Draw all that the study has into `folder`; return it in reading order."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    for view, results in study.detection.items():
        judged = {name: one for name, one in results.items() if isinstance(one, JudgedMethod)}
        if judged:
            pictures.append(_curves(judged, view, folder))
            pictures.append(_maps(judged, T_world_base, view, folder))
    for kind, registered in study.registration.items():
        errors = {n: one for n, one in registered.items() if isinstance(one, RegistrationErrors)}
        if errors and len(study.pairs[kind]):
            pictures.append(_errors(errors, kind, folder))
    return pictures


def _curves(judged: dict[str, JudgedMethod], view: str, folder: Path) -> Picture:
    path = folder / f'precision_recall_{view}.png'
    with _figure(path, (11.0, 7.0)) as figure:
        axes = figure.subplots(2, 3)
        for column, kind in enumerate(CLASSES):
            for row in (1, 2):
                ax = axes[row - 1, column]
                curves = {
                    name: getattr(one.detection, f'protocol_{row}')[kind]
                    for name, one in judged.items()
                }
                plots.draw_precision_recall(ax, curves)
                loops = next(iter(curves.values())).loops
                counted = 'loops' if row == 1 else 'pairs'
                ax.set_title(f'Protocol {row}, {_TITLES[kind]} ({loops} {counted})')
    return Picture(
        path,
        f'Precision and recall: {view_title(view)}',
        'Protocol 1 judges the most similar earlier scan of each scan, protocol 2 every pair.',
    )


def _maps(
    judged: dict[str, JudgedMethod], T_world_base: se3.Array, view: str, folder: Path
) -> Picture:
    path = folder / f'detections_{view}.png'
    columns = min(len(judged), 3)
    rows = -(-len(judged) // columns)
    extent = np.ptp(T_world_base[:, :2, 3], axis=0) + 20.0
    height = float(np.clip(4.0 * extent[1] / extent[0], 2.6, 5.0))
    with _figure(path, (4.0 * columns + 0.4, (height + 0.5) * rows)) as figure:
        axes = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for ax, (name, one) in zip(axes, judged.items(), strict=False):
            plots.draw_detections(ax, T_world_base, one.detection)
            best = one.detection.protocol_1['all'].f1_max
            ax.set_title(f'{name}, F1 {best:.2f}')
        for ax in axes[len(judged) :]:
            ax.set_axis_off()
    return Picture(
        path,
        f'True, false and missed detections: {view_title(view)}',
        'Each method at the threshold of its largest F1 score by protocol 1 (Figure 3.7).',
    )


def _errors(errors: dict[str, RegistrationErrors], kind: str, folder: Path) -> Picture:
    path = folder / f'registration_{kind}.png'
    with _figure(path, (11.0, 6.4)) as figure:
        axes = figure.subplots(2, 2)
        for column, (name, limit) in enumerate((('te_m', SUCCESS_M), ('re_deg', SUCCESS_DEG))):
            plots.draw_errors(axes[0, column], errors, name, limit)
            plots.draw_histogram(axes[1, column], errors, name, 0.25 * limit)
        if axes[0, 0].get_legend_handles_labels()[0]:
            axes[0, 0].legend(loc='lower right', fontsize=8)
    return Picture(
        path,
        f'Registration errors: pairs {pairs_title(kind)}',
        'Above, the share of pairs that are off by no more; the dotted line is the limit of '
        'success. Below, how the small errors are distributed.',
    )


def view_title(view: str) -> str:
    """Return what people call a view of the sweeps."""
    if view == 'whole':
        return 'whole sweeps'
    kind, width, *more = view.split('_')
    title = f'{width}° {"to the rear" if kind == "rear" else "at random"} removed'
    return f'{title}, with the metres before' if more else title


def pairs_title(kind: str) -> str:
    """Return what people call a kind of pairs, e.g. 0_4 or 0_4_sector_90."""
    if kind.startswith('icp'):
        return 'confirmed by ICP'
    low, high, *view = kind.split('_', 2)
    title = f'{low} to {high} m apart'
    return f'{title}, {view_title(view[0])}' if view else title


@contextmanager
def _figure(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure in the suite's style and write it; no global state, no display."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, dpi=120, layout='constrained')
        FigureCanvasAgg(figure)
        yield figure
        figure.savefig(path, facecolor='white')
