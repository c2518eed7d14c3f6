"""Evaluate place recognition on any runs: recall, failure detection, interchange of members."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lcd_common.command_line import run
from lcd_common.errors import ConfigError, DataError
from lcd_common.setting_changes import changed
from uncertain_place_recognition.ambiguity import AmbiguityConfig
from uncertain_place_recognition.datasets.regions import SITES
from uncertain_place_recognition.embedded_run import EmbeddedRun

if TYPE_CHECKING:
    from uncertain_place_recognition.ensemble import EmbeddingEnsemble

RESULTS = 'results.json'
_EXAMPLES = """
examples:
  evaluate_place_recognition runs/town --ensemble weights/ensemble.safetensors --out results/town
  evaluate_place_recognition runs/town --ensemble teacher=weights/teacher \\
      students=weights/students naive=weights/triplet dropout=weights/dropout stun=weights/stun \\
      --save-embeddings embedded/town --out results/town
  evaluate_place_recognition embedded/town --metric euclidean --out results/town_euclidean
  evaluate_place_recognition --ensemble weights --out results/mulran \\
      --database runs/mulran_DCC01.npz --queries runs/mulran_DCC02.npz
  evaluate_place_recognition runs/oxford --query-region oxford --metric euclidean \\
      --ensemble weights --out results/oxford          the PointNetVLAD benchmark's test regions
  evaluate_place_recognition embedded/town --calibration weights/calibration.json --open-set \\
      --no-match 0.3 --out results/town_open

Every run is searched in every other run of its world; runs of --database only are searched, those
of --queries only ask. A match within --radius is right; recall leaves out queries whose place the
other run does not have, and is a plain mean over pairs of runs.
Roles: teacher (one network), students (of one feature space), naive (networks trained apart, also
searched one by one as Mason et al. do), dropout (passes with dropout), stun (predicts a variance).
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    from uncertain_place_recognition.evaluation.figures import write_pictures
    from uncertain_place_recognition.evaluation.pairs import PairConfig, available
    from uncertain_place_recognition.evaluation.study import study
    from uncertain_place_recognition.evaluation.tables import text_tables
    from uncertain_place_recognition.run_inputs import load_ensembles, weights_of
    from uncertain_place_recognition.trust import Calibration

    out = results_folder(arguments.out)
    calibration = Calibration.load(arguments.calibration) if arguments.calibration else None
    settings = PairConfig(
        radius=arguments.radius, excluded=2.0 * arguments.radius, metric=arguments.metric
    )
    ensembles = load_ensembles(arguments.ensemble, arguments.device)
    runs = _runs(arguments, ensembles)
    if not available(runs):
        raise DataError(f'no ensemble embedded all runs: {_embedded_by(runs)}')
    if calibration is not None:
        if calibration.ensemble != weights_of(runs, 'students'):
            raise DataError(f'{arguments.calibration} calibrates other weights than the students')
        if calibration.metric != arguments.metric:
            raise DataError(
                f'{arguments.calibration} is of the metric {calibration.metric}; use --metric '
                f'{calibration.metric}'
            )
    found = study(
        runs,
        settings,
        None if calibration is None else calibration.model,
        arguments.open_set,
        arguments.no_match,
        arguments.seed,
        changed(AmbiguityConfig(), arguments.ambiguity),
    )
    figures = {**found.plain(), 'query_region': arguments.query_region}
    out.mkdir(parents=True, exist_ok=True)
    (out / RESULTS).write_text(json.dumps(figures, indent=2) + '\n')
    pictures = write_pictures(found, out)
    sys.stdout.write(text_tables(figures) + '\n')
    sys.stdout.write(f'written to {out}: {RESULTS}, {", ".join(p.name for p in pictures)}\n')


def _runs(
    arguments: argparse.Namespace, ensembles: 'Mapping[str, EmbeddingEnsemble]'
) -> list[EmbeddedRun]:
    """Return all runs, each with its part: databases, those that ask, and those that do both."""
    from uncertain_place_recognition.datasets.regions import in_test_region
    from uncertain_place_recognition.run_inputs import load_embedded

    if not (arguments.runs or (arguments.database and arguments.queries)):
        raise ConfigError('name runs, or runs for --database and for --queries')
    runs: list[EmbeddedRun] = []
    for paths, asks, searched in (
        (arguments.runs, True, True),
        (arguments.database, False, True),
        (arguments.queries, True, False),
    ):
        if not paths:
            continue
        keep, quiet = arguments.save_embeddings, arguments.quiet
        for one in load_embedded(paths, ensembles, keep, quiet):
            asking = None if asks else np.zeros(len(one), bool)
            if asks and arguments.query_region is not None:
                asking = in_test_region(one.positions, arguments.query_region)
            runs.append(replace(one, asking=asking, searched=searched))
    if arguments.query_region is not None and not any(one.asks for one in runs):
        raise DataError(
            f'no submap of {len(runs)} runs lies in a test region of {arguments.query_region}; are '
            "they the benchmark's, made by make_submap_runs --benchmark of this site's files?"
        )
    return runs


def results_folder(out: Path) -> Path:
    """Return a folder that may be written; raises DataError when it holds other things."""
    if out.exists() and not out.is_dir():
        raise DataError(f'{out} is a file; name a folder for the results')
    if out.is_dir() and any(out.iterdir()) and not (out / RESULTS).is_file():
        raise DataError(f'{out} holds other things than results; name another folder')
    return out


def share(text: str) -> float:
    """Return a number of 0 .. 1."""
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f'{text} is no share between 0 and 1')
    return value


def add_inputs(parser: argparse.ArgumentParser, runs: str = '+') -> None:
    """Add the arguments that name runs (+, or * where others name them too) and ensembles."""
    parser.add_argument(
        'runs', nargs=runs, type=Path, help='.npz files of runs, or folders with such'
    )
    parser.add_argument('--out', type=Path, required=True, help='folder for what is written')
    parser.add_argument(
        '--radius', type=float, default=25.0, help='matches nearer than this are right [m] (25)'
    )
    parser.add_argument('--metric', choices=('cosine', 'euclidean'), default='cosine')
    parser.add_argument(
        '--save-embeddings', type=Path, metavar='FOLDER', help='keep embeddings for later calls'
    )
    parser.add_argument(
        '--ambiguity', nargs='+', default=[], metavar='NAME=VALUE',
        help='spread of matches and ratio to the next place: '
        + ', '.join(one.name for one in fields(AmbiguityConfig)),
    )  # fmt: skip
    parser.add_argument('--device', default='cpu', help='cpu, cuda or cuda:N (cpu)')
    parser.add_argument('--seed', type=int, default=0, help='of what is drawn (0)')
    parser.add_argument('--quiet', action='store_true', help='show no progress')


def _embedded_by(runs: Sequence[EmbeddedRun]) -> str:
    return '; '.join(f'{run.name} by {", ".join(run.members) or "none"}' for run in runs)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='evaluate_place_recognition',
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_inputs(parser, runs='*')
    parser.add_argument(
        '--database', nargs='+', type=Path, default=[], metavar='RUN',
        help='runs that are searched, and do not ask',
    )  # fmt: skip
    parser.add_argument(
        '--queries', nargs='+', type=Path, default=[], metavar='RUN',
        help='runs that ask, and are not searched',
    )  # fmt: skip
    parser.add_argument(
        '--query-region', choices=SITES,
        help="ask only from the benchmark's test regions of this site; databases stay whole",
    )  # fmt: skip
    parser.add_argument(
        '--ensemble', nargs='+', default=[], metavar='[ROLE=]PATH',
        help='weights that embed submaps; without a role: students',
    )  # fmt: skip
    parser.add_argument(
        '--calibration', type=Path, metavar='FILE',
        help='of calibrate_place_recognition: judges its probabilities too',
    )  # fmt: skip
    parser.add_argument(
        '--open-set', action='store_true',
        help='failure detection counts queries whose place the other run does not have',
    )  # fmt: skip
    parser.add_argument(
        '--no-match', type=share, default=0.0, metavar='SHARE',
        help='take the place of so many queries out of the database (0)',
    )  # fmt: skip
    return parser


if __name__ == '__main__':
    sys.exit(main())
