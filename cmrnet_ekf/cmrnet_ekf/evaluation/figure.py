"""Write a picture as PNG in the suite's style; no global state, no display."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lcd_loop_closure.report.plots import STYLE

# Okabe and Ito's palette: told apart by colour-blind readers and in print. The thesis's colours of
# MCD, DE and DER are blue, orange and green; so they are here.
_KNOWN = {
    'rough': '#BBBBBB', 'cmrnet': '#222222', 'mcd': '#0072B2', 'de': '#E69F00', 'der': '#009E73',
    'motion': '#999999', 'unfiltered': '#D55E00',
}  # fmt: skip
_OTHERS = ('#CC79A7', '#56B4E9', '#D55E00', '#F0E442', '#8B5A2B')


@contextmanager
def figure(path: Path, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure of a size in inches, and write it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        canvas = Figure(figsize=size, dpi=110, layout='constrained')
        FigureCanvasAgg(canvas)
        yield canvas
        canvas.savefig(path, facecolor='white')


@contextmanager
def panels(
    path: Path, count: int, columns: int, panel: tuple[float, float]
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yield a figure with a number of panels, each of a size in inches, and write it.

    At most `columns` stand in a row; room for a bar of colours is left beside them.
    """
    columns = min(count, columns)
    rows = -(-count // columns)
    with figure(path, (panel[0] * columns + 0.8, panel[1] * rows)) as canvas:
        axes: list[Axes] = list(canvas.subplots(rows, columns, squeeze=False).ravel())
        for ax in axes[count:]:
            ax.remove()
        yield canvas, axes[:count]


def colours(names: list[str]) -> dict[str, str]:
    """Return a colour for each method: always the same for those of the thesis."""
    others = iter(_OTHERS * len(names))
    return {name: _KNOWN.get(name) or next(others) for name in names}
