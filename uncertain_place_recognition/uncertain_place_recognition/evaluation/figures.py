"""Write pictures of an evaluation, or of a calibration, as PNG."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcd_loop_closure.report.plots import STYLE
from uncertain_place_recognition.evaluation import plots
from uncertain_place_recognition.evaluation.study import Study


def write_pictures(study: Study, folder: Path) -> list[Path]:
    """Draw all that a study has into a folder; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    if plots.shown(study.scores):
        path = folder / 'removal.png'
        with figure(path, (13.0, 5.0)) as canvas:
            axes = canvas.subplots(1, 3)
            for ax, n in zip(axes, (1, 5, 10), strict=True):
                plots.draw_removal(ax, study.scores, n)
                ax.set_title(f'Recall@{n} without the most doubted')
            handles = axes[0].get_legend_handles_labels()
            canvas.legend(*handles, loc='outside lower center', ncols=5, fontsize=9)
        written.append(path)
        path = folder / 'risk_coverage.png'
        with figure(path, (6.4, 4.6)) as canvas:
            ax = canvas.subplots()
            plots.draw_risk_coverage(ax, study.scores)
            ax.set_title('Errors among the least doubted')
            ax.legend(fontsize=8)
        written.append(path)
    if study.reliability is not None:
        path = folder / 'reliability.png'
        with figure(path, (4.8, 4.8)) as canvas:
            ax = canvas.subplots()
            plots.draw_reliability(ax, study.reliability)
            ax.set_title('Probability that a match is wrong')
        written.append(path)
    if study.interchange:
        path = folder / 'interchange.png'
        with figure(path, (4.6 * len(study.interchange), 5.0)) as canvas:
            axes = canvas.subplots(1, len(study.interchange), squeeze=False)[0]
            for ax, (name, found) in zip(axes, study.interchange.items(), strict=True):
                plots.draw_matrix(ax, found.recall)
                ax.set_title(f'{name}, R@1 [%] (chance {100 * found.chance:.1f})')
        written.append(path)
    return written


@contextmanager
def figure(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure in the suite's style and write it; no global state, no display."""
    with mpl.rc_context(STYLE):
        canvas = Figure(figsize=size, dpi=120, layout='constrained')
        FigureCanvasAgg(canvas)
        yield canvas
        canvas.savefig(path, facecolor='white')
