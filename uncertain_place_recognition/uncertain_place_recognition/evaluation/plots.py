"""Draw what an evaluation found; every function draws on the axes it is given."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from lcd_loop_closure.evaluation.plots import COLOURS
from uncertain_place_recognition.evaluation.calibration_error import Reliability
from uncertain_place_recognition.evaluation.scores import REMOVED, JudgedScore

# Ours first and in the same colour everywhere.
ORDER = (
    'shared_combined', 'shared_u', 'distance', 'mason_variance', 'mason_similarity', 'naive',
    'dropout', 'stun',
)  # fmt: skip
LABELS = {
    'shared_combined': 'shared space, combined',
    'shared_u': 'shared space, u',
    'distance': 'top-1 distance',
    'mason_variance': 'Mason, variance',
    'mason_similarity': 'Mason, similarity',
    'naive': 'naive ensemble, u',
    'dropout': 'MC dropout, u',
    'stun': 'STUN, variance',
}


def draw_removal(ax: Axes, scores: Mapping[str, JudgedScore], n: int = 1) -> None:
    """Draw the gain in recall at n over the share of queries removed (Figures 4.3 to 4.6)."""
    chosen = shown(scores)
    for name, one in chosen.items():
        gain = 100.0 * (one.removal[n] - one.removal[n][0])
        ax.plot(100.0 * REMOVED, gain, **_line(name))
    bounds = _envelope([100.0 * (one.oracle[n] - one.oracle[n][0]) for one in chosen.values()])
    if bounds is not None:
        low, high = bounds
        ax.fill_between(100.0 * REMOVED, low, high, color='#222222', alpha=0.08, lw=0)
        ax.plot(100.0 * REMOVED, high, color='#222222', lw=1.0, ls=':', label='oracle')
    ax.axhline(0.0, color='#222222', lw=1.0, ls='--', label='random')
    ax.set_xlim(0.0, 90.0)
    ax.set_xlabel('queries removed [%]')
    ax.set_ylabel(f'change of recall@{n} [points]')


def draw_risk_coverage(ax: Axes, scores: Mapping[str, JudgedScore]) -> None:
    """Draw the share of wrong matches among the least doubted, over their share of all."""
    for name, one in shown(scores).items():
        step = max(len(one.risk) // 500, 1)
        ax.plot(one.coverage[::step], one.risk[::step], **_line(name))
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel('share of queries answered')
    ax.set_ylabel('share of answers that is wrong')


def draw_reliability(ax: Axes, found: Reliability) -> None:
    """Draw observed over predicted rates of wrong matches, with 95 % binomial bars."""
    spread = 1.96 * np.sqrt(found.observed * (1.0 - found.observed) / found.queries)
    ax.plot([0, 1], [0, 1], color='#222222', lw=1.0, ls=':')
    ax.errorbar(
        found.predicted, found.observed, yerr=spread, color=COLOURS[0], lw=1.5, marker='o', ms=4,
        elinewidth=1.0,
    )  # fmt: skip
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(-0.02, 1.02)
    ax.set_aspect('equal')
    ax.set_xlabel('predicted probability of a wrong match')
    ax.set_ylabel('observed share')
    ax.text(0.04, 0.94, f'ECE {found.ece:.3f}', transform=ax.transAxes, va='top')


def draw_matrix(ax: Axes, recall: NDArray[np.float64]) -> None:
    """Draw recall at 1 of database members (rows) and query members (columns), per cent."""
    ax.grid(visible=False)
    ax.imshow(recall, vmin=0.0, vmax=1.0, cmap='Blues')
    names = [f'm{k + 1}' for k in range(len(recall))]
    ax.set_xticks(range(len(recall)), names)
    ax.set_yticks(range(len(recall)), names)
    ax.set_xlabel('queries by')
    ax.set_ylabel('database by')
    for i, row in enumerate(recall):
        for j, share in enumerate(row):
            colour = 'white' if share > 0.6 else '#222222'
            ax.text(j, i, f'{100 * share:.1f}', ha='center', va='center', color=colour)


def shown(scores: Mapping[str, JudgedScore]) -> dict[str, JudgedScore]:
    """Return the doubts that pictures show, in their order."""
    return {name: scores[name] for name in ORDER if name in scores}


def _line(name: str) -> dict[str, object]:
    ours = name.startswith('shared')
    return {
        'color': COLOURS[ORDER.index(name)],
        'lw': 2.4 if ours else 1.5,
        'zorder': 4 if ours else 3,
        'label': LABELS[name],
    }


def _envelope(
    curves: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the lowest and highest of the oracles: each method has its own errors to find."""
    if not curves:
        return None
    return np.min(curves, axis=0), np.max(curves, axis=0)
