"""Judge trained networks on samples: the command `evaluate_cmrnet`."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from cmrnet_ekf.evaluation.measures import MCD_COUNTS
from cmrnet_ekf.evaluation.named_networks import named_predictors
from cmrnet_ekf.evaluation.study import Study, study
from cmrnet_ekf.evaluation.tables import localization, markdown
from cmrnet_ekf.training.sample_set import SampleSet
from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError

RESULTS = 'results.json'
_EXAMPLES = """
examples:
  make_cmrnet_samples towns:200-201 --out test                first, once: towns nobody trained on
  evaluate_cmrnet test/town_* --networks cmrnet=runs/plain0 mcd=runs/mcd der=runs/der \\
      de=runs/plain0,runs/plain1,runs/plain2,runs/plain3,runs/plain4 --out results
  evaluate_cmrnet test/town_* --networks der=runs/der nll=runs/nll --out ablation
                                                              other losses beside each other
  evaluate_cmrnet test/town_* --networks cmrnet=runs/plain0 --second cmrnet=runs/second \\
      --third cmrnet=runs/third --out refined                 three stages, each from the last one
  evaluate_cmrnet test/town_* --networks der=runs/der --per-set 200 --out quick

Any names do; what a network is, its file says: one with dropout is MC dropout, several files are
an ensemble. Written are results.json, results.md, predictions.npz (targets, means, scales and
degrees of freedom, to judge by other measures) and pictures. Nothing is fitted to the samples; the
thresholds of rejection are the top 15 % of the traces of these samples, as in the thesis.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _evaluate(arguments))


def _evaluate(arguments: argparse.Namespace) -> None:
    from cmrnet_ekf.evaluation.plots import write_pictures

    out = results_folder(arguments.out)
    if arguments.third and not arguments.second:
        raise ConfigError('--third refines what --second found; give both')
    sets = [SampleSet(path) for path in arguments.samples]
    draws = 30 if arguments.no_counts else max(MCD_COUNTS)
    device = choose_device(arguments.device)
    first = named_predictors(arguments.networks, device, draws)
    later = [
        named_predictors(texts, device) for texts in (arguments.second, arguments.third) if texts
    ]
    asked = sum(min(len(one), arguments.per_set or len(one)) for one in sets)
    passes = len(first) + (len(later[0]) if later else 0)
    with tqdm(total=asked * passes, unit='sample', disable=arguments.quiet) as bar:
        found = study(first, sets, later, arguments.per_set, bar.update)
    figures = found.plain()
    out.mkdir(parents=True, exist_ok=True)
    (out / RESULTS).write_text(json.dumps(figures, indent=1) + '\n')
    write_predictions(found, out / 'predictions.npz')
    pictures = [path.name for path in write_pictures(found, out)]
    (out / 'results.md').write_text(markdown(figures, pictures))
    sys.stdout.write(localization(figures['localization']))
    sys.stdout.write(f'written to {out}: {RESULTS}, results.md, {", ".join(pictures)}\n')


def write_predictions(found: Study, path: Path) -> None:
    """Write what methods said: target, and NAME_mean, NAME_scale, NAME_freedom [N x 6]."""
    arrays = {}
    for name, one in found.answers.items():
        arrays['target'] = one.target
        belief = {'mean': one.belief.mean, 'scale': one.belief.scale, 'freedom': one.belief.freedom}
        arrays |= {f'{name}_{key}': value for key, value in belief.items()}
    np.savez_compressed(path, allow_pickle=False, **arrays)


def results_folder(out: Path) -> Path:
    """Return a folder that may be written; raises DataError when it holds other things."""
    if out.is_dir() and any(out.iterdir()) and not (out / RESULTS).is_file():
        raise DataError(f'{out} holds other things than results; name another folder')
    if out.exists() and not out.is_dir():
        raise DataError(f'{out} is a file; name a folder for the results')
    return out


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='evaluate_cmrnet',
        description='Judge trained networks on samples: errors, calibration, rejection.',
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('samples', type=Path, nargs='+', metavar='SET', help='sets of make_cmrnet_samples')
    add('--networks', nargs='+', required=True, metavar='NAME=PATH[,PATH]',
        help='weights, or folders of train_cmrnet; several are an ensemble')  # fmt: skip
    add('--second', nargs='+', default=[], metavar='NAME=PATH[,PATH]',
        help='networks of the second stage, by the same names')  # fmt: skip
    add('--third', nargs='+', default=[], metavar='NAME=PATH[,PATH]', help='of the third')
    add('--out', type=Path, required=True, help='folder for the results')
    add('--per-set', type=_count, metavar='N', help='samples of each set (default: all)')
    add('--no-counts', action='store_true', help='30 draws of MC dropout, no other numbers')
    add('--device', default='auto', help='auto, cpu, cuda, cuda:1 ... (default: auto)')
    add('--quiet', action='store_true', help='no progress bar')
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 2:
        raise argparse.ArgumentTypeError(f'{text} is no number of at least 2')
    return int(text)


if __name__ == '__main__':
    sys.exit(main())
