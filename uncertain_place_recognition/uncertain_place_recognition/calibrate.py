"""Calibrate an ensemble on runs it was not trained on: when may a match be believed?"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lcd_common.command_line import run
from lcd_common.setting_changes import changed
from uncertain_place_recognition.acceptance import KINDS, available, needed
from uncertain_place_recognition.ambiguity import AmbiguityConfig
from uncertain_place_recognition.evaluate import RESULTS, add_inputs, results_folder, share

if TYPE_CHECKING:
    from uncertain_place_recognition.calibration import Calibrated
    from uncertain_place_recognition.query_table import QueryTable

_EXAMPLES = """
examples:
  calibrate_place_recognition runs/calibration --ensemble weights/ensemble.safetensors \\
      --out weights/calibrated
  calibrate_place_recognition runs/calibration --ensemble weights --out weights/calibrated \\
      --target 0.05 --kind false_match_rate_by_run
  calibrate_place_recognition embedded/calibration --out weights/calibrated --resplits 100

Every run is searched in the map that all other runs make, those of other worlds included: a
promise covers maps up to a tenth larger than that (--apart: only those of its world). Of a share of
the queries (--no-match) the place is taken out of that map first, because places that are not in
the map are what must be refused. Keep the places of the map as far apart as the submaps here. A
third of the runs teaches the probability that a match is wrong; the others choose the
threshold for each target.

kinds of promises, and what they need for 1 % (5 %):
  false_match_rate         P(accepted | wrong) on average: 99 (19) wrong matches
  false_match_rate_by_run  the same for a new run: 99 (19) runs; the honest one where runs differ
  false_accepts            P(accepted and wrong) on average: 99 (19) queries
  precision                P(wrong | accepted) with --confidence: 299 (59) accepted without error

written: calibration.json (--kind, --target), calibration_01.json, calibration_05.json ... (the
other targets), results.json and pictures. Copy calibration.json beside the weights and the node
uses it. It holds for maps of about the same size, and until the drift alarm.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    from uncertain_place_recognition.calibration import TARGETS, calibrate
    from uncertain_place_recognition.evaluation.guarantee import observe
    from uncertain_place_recognition.evaluation.pairs import PairConfig
    from uncertain_place_recognition.query_table import query_table, spacing_m
    from uncertain_place_recognition.run_inputs import load_embedded, load_ensembles, weights_of
    from uncertain_place_recognition.trust import Calibration

    out = results_folder(arguments.out)
    ensembles = load_ensembles(arguments.ensemble[:1], arguments.device)
    runs = load_embedded(arguments.runs, ensembles, arguments.save_embeddings, arguments.quiet)
    weights = weights_of(runs, 'students')
    settings = PairConfig(
        radius=arguments.radius, excluded=2.0 * arguments.radius, metric=arguments.metric
    )
    ambiguity = changed(AmbiguityConfig(), arguments.ambiguity)
    table = query_table(
        runs, settings, arguments.no_match, arguments.seed, ambiguity, together=not arguments.apart
    )
    targets = sorted({*TARGETS, arguments.target})
    found = calibrate(table, targets, confidence=arguments.confidence, seed=arguments.seed)
    observed = []
    if arguments.resplits:
        observed = observe(table, targets, resplits=arguments.resplits, seed=arguments.seed)
    out.mkdir(parents=True, exist_ok=True)
    for target in targets:
        acceptance = found.acceptance(arguments.kind, target)
        file = Calibration(
            weights, table.metric, found.model, acceptance, found.drift, ambiguity, spacing_m(runs)
        )
        name = 'calibration' if target == arguments.target else f'calibration_{_percent(target)}'
        file.save(out / f'{name}.json')
    figures = _figures(found, table)
    figures['resplits'] = [one.plain() for one in observed]
    figures['ambiguity'] = asdict(ambiguity)
    (out / RESULTS).write_text(json.dumps(figures, indent=2) + '\n')
    _draw(found, table, out)
    sys.stdout.write(_text(figures) + f'\nwritten to {out}\n')


def _percent(target: float) -> str:
    """Return a target as a part of a file's name: 01 is 1 %, 001 is 0.1 %."""
    return f'{target:.12f}'.rstrip('0').partition('.')[2].ljust(2, '0')


def _figures(found: 'Calibrated', table: 'QueryTable') -> dict[str, Any]:
    held = table.of_runs(found.threshold_runs)
    belief = found.model.belief(held.features)
    rows = []
    for one in found.acceptances:
        accepted = one.accepts(belief)
        right = max(int((~held.wrong).sum()), 1)
        shown = {**one.plain(), 'accepted_right': float((accepted & ~held.wrong).sum() / right)}
        shown['needed'] = needed(one.kind, one.target, one.confidence or 0.95)
        shown['available'] = available(one.kind, belief, held.wrong, held.run)
        rows.append(shown)
    return {
        'queries': len(table),
        'no_match': int((~table.known).sum()),
        'wrong': int(table.wrong.sum()),
        'runs': len(table.runs),
        'fit_runs': [table.names[k] for k in found.fit_runs],
        'threshold_runs': [table.names[k] for k in found.threshold_runs],
        'database_size': table.database_size,
        'metric': table.metric,
        'ece': found.reliability.ece,
        'brier': found.reliability.brier,
        'weights': dict(zip(found.model.names, found.model.weights.tolist(), strict=True)),
        'drift_false_alarms': found.false_alarms,
        'acceptances': rows,
    }


def _draw(found: 'Calibrated', table: 'QueryTable', out: Path) -> None:
    from uncertain_place_recognition.evaluation import calibration_plots, plots
    from uncertain_place_recognition.evaluation.figures import figure

    held = table.of_runs(found.threshold_runs)
    with figure(out / 'calibration.png', (13.0, 4.4)) as canvas:
        axes = canvas.subplots(1, 3)
        plots.draw_reliability(axes[0], found.reliability)
        axes[0].set_title('Probabilities on runs not fitted to')
        calibration_plots.draw_beliefs(axes[1], found, held)
        axes[1].set_title('Beliefs, and thresholds')
        calibration_plots.draw_risk_coverage(axes[2], found, held)
        axes[2].set_title('Errors among the least doubted')


def _text(figures: dict[str, Any]) -> str:
    from uncertain_place_recognition.evaluation.tables import table

    head = (
        f'{figures["queries"]} queries of {figures["runs"]} runs, {figures["no_match"]} without '
        f'their place in the map, {figures["wrong"]} wrong; map of {figures["database_size"]}\n'
        f'ECE {figures["ece"]:.3f}; drift alarm in {100 * figures["drift_false_alarms"]:.0f} % of '
        'runs against the others\n\n'
    )
    rows = [
        [
            one['kind'], f'{100 * one["target"]:g} %',
            'none' if one['threshold'] is None else f'{one["threshold"]:.3f}',
            f'{100 * one["accepted_right"]:.1f} %',
        ]
        for one in figures['acceptances']
    ]  # fmt: skip
    text = head + table(['promise', 'target', 'belief above', 'right ones accepted'], rows)
    text += ''.join(_lacking(one) for one in figures['acceptances'] if one['threshold'] is None)
    if figures['resplits']:
        rows = [
            [
                one['kind'], f'{100 * one["target"]:g} %',
                '-' if one['observed'] is None else f'{100 * one["observed"]:.2f} %',
                '-' if one['low'] is None else f'{100 * one["low"]:.2f}-{100 * one["high"]:.2f}',
                f'{100 * one["accepted_right"]:.1f} %', f'{100 * one["without"]:.0f} %',
            ]
            for one in figures['resplits']
        ]  # fmt: skip
        header = ['on resplits', 'target', 'observed', '95 %', 'right ones', 'no threshold']
        text += '\n' + table(header, rows)
    return text


def _lacking(one: dict[str, Any]) -> str:
    """Return a line that says what a promise without a threshold lacks."""
    what, there = {
        'false_match_rate': ('wrong matches', 'there are'),
        'false_match_rate_by_run': ('runs with wrong matches', 'there are'),
        'false_accepts': ('queries', 'there are'),
        'precision': (
            'matches accepted without error, more with errors',
            'above the most believed wrong one lie',
        ),
    }[one['kind']]
    return (
        f'no threshold for {one["kind"]} of {100 * one["target"]:g} %: it needs at least '
        f'{one["needed"]} {what}; {there} {one["available"]} in the {one["runs"]} runs that choose '
        'thresholds\n'
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='calibrate_place_recognition',
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_inputs(parser)
    parser.add_argument(
        '--ensemble', nargs=1, default=[], metavar='PATH', help='weights that embed submaps'
    )
    parser.add_argument(
        '--target', type=share, default=0.01, help='rate of errors of calibration.json (0.01)'
    )
    parser.add_argument('--kind', choices=KINDS, default=KINDS[0], help=f'({KINDS[0]})')
    parser.add_argument('--confidence', type=share, default=0.95, help='of precision (0.95)')
    parser.add_argument(
        '--no-match', type=share, default=0.5, metavar='SHARE',
        help='queries whose place is taken out of the map (0.5)',
    )  # fmt: skip
    parser.add_argument(
        '--apart', action='store_true',
        help='each world has a map of its own (default: all share one, and the promise covers it)',
    )  # fmt: skip
    parser.add_argument(
        '--resplits', type=int, default=0, metavar='N',
        help='split the runs N times and count what is kept on runs not seen (0)',
    )  # fmt: skip
    return parser


if __name__ == '__main__':
    sys.exit(main())
