"""Draw what an evaluation found; every function draws on the axes it is given."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.evaluation.detection import Detection
from lcd_loop_closure.evaluation.detection_protocols import PrecisionRecall
from lcd_loop_closure.evaluation.registration_errors import RegistrationErrors

# Okabe and Ito's palette, told apart by colour-blind readers; LCDNet's blue comes first.
COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#666666', '#F0E442')
TRUE, FALSE, MISSED = '#009E73', '#D55E00', '#0072B2'
_MOST_POINTS = 600


def draw_precision_recall(ax: Axes, curves: Mapping[str, PrecisionRecall]) -> None:
    """Draw curves by the names of methods (Figure 3.4)."""
    for number, (name, curve) in enumerate(curves.items()):
        if not curve.loops:
            continue
        step = max(len(curve.recall) // _MOST_POINTS, 1)
        chosen = np.unique(np.r_[np.arange(0, len(curve.recall), step), len(curve.recall) - 1])
        ax.plot(
            curve.recall[chosen],
            curve.precision[chosen],
            color=COLOURS[number % len(COLOURS)],
            lw=2.4 if name.startswith('lcdnet') else 1.5,
            zorder=4 if name.startswith('lcdnet') else 3,
            label=f'{name}: {curve.average_precision:.3f}',
        )
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(0.0, 1.03)
    ax.set_xlabel('recall')
    ax.set_ylabel('precision')
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            title='average precision', loc='lower left', fontsize=8, title_fontsize=8,
            frameon=True, framealpha=0.85, edgecolor='none',
        )  # fmt: skip


def draw_detections(ax: Axes, T_world_base: se3.Array, detection: Detection) -> None:
    """Draw true, false and missed detections on the trajectory (Figure 3.7).

    Accepted is what lies below the threshold of the largest F1 score by protocol 1.
    """
    positions, found = T_world_base[:, :3, 3], detection.found
    ax.plot(positions[:, 0], positions[:, 1], color='#bbbbbb', lw=1.2, zorder=1)
    limit = detection.protocol_1['all'].best_threshold
    accepted = np.zeros(len(found), bool) if limit is None else found.distance <= limit
    kinds = (
        ('missed', ~accepted & found.loop, MISSED, 2),
        ('true', accepted & found.right, TRUE, 3),
        ('false', accepted & ~found.right, FALSE, 4),
    )
    for name, mask, colour, order in kinds:
        at = positions[found.query[mask]]
        ax.scatter(
            at[:, 0], at[:, 1], s=11 if name == 'false' else 7, color=colour, zorder=order,
            label=f'{name} ({int(mask.sum())})', linewidths=0,
        )  # fmt: skip
    ax.set_aspect('equal', adjustable='datalim')
    ax.set_xlabel('x [m]')
    ax.set_ylabel('y [m]')
    ax.legend(loc='best', fontsize=8, markerscale=2.0)


def draw_errors(
    ax: Axes, errors: Mapping[str, RegistrationErrors], kind: str, limit: float
) -> None:
    """Draw the share of pairs [0..1] over their error, one line a method.

    Args:
        ax: axes to draw on.
        errors: by the names of methods.
        kind: `te_m` or `re_deg`.
        limit: of success, drawn as a line.
    """
    top = 2.0 * limit
    for number, (name, one) in enumerate(errors.items()):
        if one.yaw_only or not len(one):
            continue
        values: NDArray[np.float64] = np.sort(np.nan_to_num(getattr(one, kind), nan=np.inf))
        share = np.arange(1, len(values) + 1) / len(values)
        shown = values <= top
        ax.step(
            np.r_[0.0, values[shown], top],
            np.r_[0.0, share[shown], share[shown][-1] if shown.any() else 0.0],
            where='post',
            color=COLOURS[number % len(COLOURS)],
            lw=2.4 if name.startswith('lcdnet') else 1.5,
            label=name,
        )
    ax.axvline(limit, color='#222222', lw=1.0, ls=':')
    ax.set_xlim(0.0, top)
    ax.set_ylim(0.0, 1.03)
    ax.set_xlabel('translation error [m]' if kind == 'te_m' else 'rotation error [deg]')
    ax.set_ylabel('share of pairs')


def draw_histogram(
    ax: Axes, errors: Mapping[str, RegistrationErrors], kind: str, top: float
) -> None:
    """Draw how errors up to `top` are distributed, as lines over 40 bins."""
    bins = np.linspace(0.0, top, 41)
    for number, (name, one) in enumerate(errors.items()):
        if one.yaw_only:
            continue
        values = getattr(one, kind)
        counts, _ = np.histogram(values[np.isfinite(values)], bins)
        ax.stairs(
            counts, bins, color=COLOURS[number % len(COLOURS)], lw=1.5, label=name,
            fill=number == 0, alpha=0.55 if number == 0 else 1.0,
        )  # fmt: skip
    ax.set_xlim(0.0, top)
    ax.set_xlabel('translation error [m]' if kind == 'te_m' else 'rotation error [deg]')
    ax.set_ylabel('pairs')
