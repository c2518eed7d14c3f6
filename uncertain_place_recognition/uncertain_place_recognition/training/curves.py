"""Draw how a training goes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_place_recognition.training.optional import has_matplotlib


def draw_curves(folder: Path) -> None:
    """Draw training.jsonl and validation.jsonl of a folder into curves.png, given matplotlib."""
    if not has_matplotlib():
        return
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    steps, judged = rows(folder / 'training.jsonl'), rows(folder / 'validation.jsonl')
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), constrained_layout=True)
    at = np.array([row['step'] for row in steps])
    width = max(1, len(at) // 60)
    for axis, names in (
        (axes[0], {'loss': 'loss'}),
        (axes[1], {'active': 'anchors that violate the margin', 'apart': 'different places apart'}),
    ):
        for name, label in names.items():
            axis.plot(at, _smooth(np.array([row[name] for row in steps]), width), label=label)
        axis.legend(fontsize=8)
    axes[0].set_yscale('symlog', linthresh=1e-3)
    axes[1].set_ylim(bottom=0.0)
    for name, label in (
        ('recall_1', 'recall@1'),
        ('teacher_recall_1', "recall@1 in the teacher's map"),
        ('gap', 'distance to the teacher'),
    ):
        shown = [(row['step'], row[name]) for row in judged if row.get(name) is not None]
        if shown:
            axes[2].plot(*zip(*shown, strict=True), '.-', label=label)
    axes[2].set_ylim(bottom=0.0)
    axes[2].set_title('validation')
    axes[2].legend(fontsize=8)
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.set_xlabel('step')
    figure.savefig(folder / 'curves.png', dpi=90)
    plt.close(figure)


def rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file with one JSON object a line; none where there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _smooth(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return running means that keep the length."""
    if len(values) < 2 * width:
        return values
    padded = np.concatenate([np.full(width - 1, values[0]), values])
    return np.convolve(padded, np.ones(width) / width, mode='valid')
