"""Draw how a training goes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def draw_curves(folder: Path) -> None:
    """Draw training.jsonl and validation.jsonl of a folder into curves.png."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    steps = _rows(folder / 'training.jsonl')
    judged = _rows(folder / 'validation.jsonl')
    figure, axes = plt.subplots(2, 2, figsize=(10, 6), constrained_layout=True)
    at = np.array([row['step'] for row in steps])
    width = max(1, len(at) // 60)
    for axis, names in (
        (axes[0, 0], {'triplet': 'triplet', 'matching': 'matching'}),
        (axes[0, 1], {'pose_m': 'pose (m)', 'transport_m': 'soft matches (m)'}),
    ):
        for name, label in names.items():
            values = np.array([row[name] for row in steps])
            axis.plot(at, _smooth(values, width), label=label)
        axis.set_yscale('log')
        axis.set_title('losses')
        axis.legend()
    axes[1, 0].plot(at, _smooth(np.array([row['different_distance'] for row in steps]), width))
    axes[1, 0].set_title('descriptor distance of different places')
    axes[1, 0].set_ylim(bottom=0.0)
    for name, label in (
        ('average_precision', 'average precision'),
        ('loops_success', 'registered, up to 4 m'),
        ('far_success', 'registered, 4 to 15 m'),
    ):
        axes[1, 1].plot(
            [row['step'] for row in judged], [row[name] for row in judged], '.-', label=label
        )
    axes[1, 1].set_ylim(0.0, 1.02)
    axes[1, 1].set_title('validation towns')
    axes[1, 1].legend()
    for axis in axes.ravel():
        axis.grid(alpha=0.3)
        axis.set_xlabel('step')
    figure.savefig(folder / 'curves.png', dpi=90)
    plt.close(figure)


def draw_place_head(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Draw how the training of the place head goes: rows of step, loss and average precision."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), constrained_layout=True)
    losses = [row for row in rows if 'loss' in row]
    left.plot([row['step'] for row in losses], [row['loss'] for row in losses], '.-', label='loss')
    left.plot(
        [row['step'] for row in losses],
        [row['confused'] for row in losses],
        '.-',
        label='share of confused loops',
    )
    left.legend()
    for name, label in (('average_precision', 'whole'), ('without_sectors', 'without sectors')):
        right.plot([row['step'] for row in rows], [row[name] for row in rows], '.-', label=label)
    right.legend()
    right.set_title('average precision on validation drives')
    for axis in (left, right):
        axis.set_xlabel('step')
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Return running means that keep the length."""
    if len(values) < 2 * width:
        return values
    kernel = np.ones(width) / width
    padded = np.concatenate([np.full(width - 1, values[0]), values])
    return np.convolve(padded, kernel, mode='valid')
