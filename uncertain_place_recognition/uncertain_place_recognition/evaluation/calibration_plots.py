"""Draw what a calibration chose; every function draws on the axes it is given."""

import numpy as np
from matplotlib.axes import Axes

from lcd_loop_closure.evaluation.plots import COLOURS, FALSE, TRUE
from uncertain_place_recognition.calibration import Calibrated
from uncertain_place_recognition.evaluation.failure import risk_coverage
from uncertain_place_recognition.query_table import QueryTable


def draw_beliefs(ax: Axes, found: Calibrated, held: QueryTable) -> None:
    """Draw how beliefs of right and wrong matches are distributed, and where 1 % and 5 % lie."""
    belief = found.model.belief(held.features)
    low, high = np.quantile(belief, [0.001, 0.999])
    bins = np.linspace(float(low), float(high), 50)
    for name, chosen, colour in (('right', ~held.wrong, TRUE), ('wrong', held.wrong, FALSE)):
        if chosen.any():
            ax.hist(
                belief[chosen], bins, color=colour, alpha=0.55,
                label=f'{name} ({int(chosen.sum())})',
            )  # fmt: skip
    for number, one in enumerate(a for a in found.acceptances if a.kind == 'false_match_rate'):
        if one.threshold is not None:
            style = ('-', '--', ':', '-.')[number % 4]
            ax.axvline(
                one.threshold, color='#222222', lw=1.2, ls=style,
                label=f'false matches {100 * one.target:g} %',
            )  # fmt: skip
    ax.set_xlabel('belief (logit that the match is right)')
    ax.set_ylabel('queries')
    ax.legend(fontsize=8)


def draw_risk_coverage(ax: Axes, found: Calibrated, held: QueryTable) -> None:
    """Draw the errors among the least doubted, for the model and each of its features."""
    doubts = {'combined': -found.model.belief(held.features)}
    doubts |= {name: held.features[:, k] for k, name in enumerate(found.model.names)}
    for number, (name, doubt) in enumerate(doubts.items()):
        coverage, risk = risk_coverage(doubt, held.wrong)
        step = max(len(risk) // 500, 1)
        ax.plot(
            coverage[::step], risk[::step], color=COLOURS[number], lw=1.5 if number else 2.4,
            label=name, zorder=3 if number else 4,
        )  # fmt: skip
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(bottom=0.0)
    ax.set_xlabel('share of queries answered')
    ax.set_ylabel('share of answers that is wrong')
    ax.legend(fontsize=8)
