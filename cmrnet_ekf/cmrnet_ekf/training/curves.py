"""Draw how a training went."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

_log = logging.getLogger(__name__)


def draw_curves(folder: Path) -> None:
    """Write curves.png from training.jsonl and validation.jsonl; without matplotlib, nothing."""
    try:
        import matplotlib as mpl

        mpl.use('Agg')
        import matplotlib.pyplot as plt
    except ImportError:
        _log.info('matplotlib is not installed: no curves.png; the .jsonl files have the numbers')
        return
    steps, judged = _rows(folder / 'training.jsonl'), _rows(folder / 'validation.jsonl')
    figure, axes = plt.subplots(2, 2, figsize=(12, 7), layout='constrained')
    at = np.array([row['step'] for row in steps])
    for axis, names in (
        (axes[0, 0], ('total', 'evidence')),
        (axes[0, 1], ('translation', 'rotation')),
    ):
        for name in names:
            values = np.array([row[name] for row in steps])
            if values.any():
                axis.plot(at, _smooth(values, max(1, len(values) // 100)), label=name)
        axis.set_yscale('symlog', linthresh=0.01)
        axis.set_title('training losses')
    for name, label in (('t_median_m', 'translation, m'), ('r_median_deg', 'rotation, degrees')):
        axes[1, 0].plot(
            [r['step'] for r in judged], [r['errors'][name] for r in judged], '.-', label=label
        )
    axes[1, 0].set_title('validation: median errors')
    for component in ('x', 'y', 'z', 'roll', 'pitch', 'yaw'):
        known = [r for r in judged if r['calibration']]
        axes[1, 1].plot(
            [r['step'] for r in known], [r['calibration'][component] for r in known], '.-',
            label=component,
        )  # fmt: skip
    axes[1, 1].set_title('validation: calibration errors')
    for axis in axes.ravel():
        axis.grid(alpha=0.3)
        axis.set_xlabel('step')
        if axis.lines:
            axis.legend()
    figure.savefig(folder / 'curves.png', dpi=90)
    plt.close(figure)


def _rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Return running means that keep the length."""
    kernel = np.ones(width) / width
    padded = np.concatenate([np.full(width - 1, values[0]), values])
    return np.convolve(padded, kernel, mode='valid')
