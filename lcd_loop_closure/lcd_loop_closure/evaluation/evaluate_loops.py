"""Judge loop detectors and registrations on a drive with known poses.

Every method sees the same sweeps. Tables are printed and written to OUT with curves and maps:
results.json, report.html and plots/.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from bags.input_arguments import add_input, drive_from
from lcd_common.command_line import run
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure.evaluation import study as studies
from lcd_loop_closure.evaluation.drive_sweeps import store_drive
from lcd_loop_closure.evaluation.figures import write_pictures
from lcd_loop_closure.evaluation.methods import DESCRIPTORS, REGISTRATIONS, Methods
from lcd_loop_closure.evaluation.page import text_tables, write_page
from lcd_loop_closure.evaluation.registration_pairs import Band, choose_pairs
from lcd_loop_closure.evaluation.study import Study
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, is_stored
from lcd_loop_closure.evaluation.sweep_views import Aggregated, RearBlocked, SectorRemoved, Sweeps
from lcd_loop_closure.report.reference import mounting_in_base, read_reference
from lcd_loop_closure.revisits import RevisitConfig, count_revisits

RESULTS = 'results.json'
_EXAMPLES = """
examples:
  evaluate_loops kitti/sequences/08 --out results/08 --truth semantic_kitti/08/poses.txt \\
      --truth-frame camera
  evaluate_loops kitti_360 --sequence 02 --out results/k360_02 --methods lcdnet scan_context
  evaluate_loops town:200 --out results/town --spacing 1 --sector 45 90
  evaluate_loops drive.mcap --out results/monday --weights my.safetensors --registration lcdnet \\
      kiss_matcher --bands 0-4 4-10 10-15 --pairs 1000
  evaluate_loops drive.mcap --out results/freiburg --freiburg --registration lcdnet
  evaluate_loops drive.mcap --out results/again --cache build/sweeps      read once, judged often

Scan i (from --first on) is compared with the scans before i - --excluded; it returns to a place
when one of them lies within --radius. Protocol 1 judges the most similar of them, protocol 2 every
pair. Registration succeeds within 2 m and 5 degrees.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    out: Path = arguments.out
    if out.is_dir() and any(out.iterdir()) and not (out / RESULTS).is_file():
        raise DataError(f'{out} holds other things than results; name another folder')
    if out.exists() and not out.is_dir():
        raise DataError(f'{out} is a file; name a folder for the results')
    settings = RevisitConfig(
        distance=10.0 if arguments.freiburg else arguments.radius,
        excluded_scans=100 if arguments.freiburg else arguments.excluded,
        first_scan=arguments.first,
    )
    bands = [_band(text) for text in arguments.bands]
    out.mkdir(parents=True, exist_ok=True)
    temporary = arguments.cache is None
    cache: Path = out / 'cache' if temporary else arguments.cache
    bar = studies.no_bar if arguments.quiet else studies.terminal_bar
    methods = _methods(arguments)
    try:
        sweeps = _sweeps(arguments, cache, bar)
        study = _study(arguments, methods, sweeps, settings, bands, cache, bar)
    finally:
        if temporary:
            shutil.rmtree(cache, ignore_errors=True)
    figures = _figures(sweeps, settings, study, arguments)
    pictures = write_pictures(study, sweeps.T_world_base, out / 'plots')
    write_page(figures, pictures, out / 'report.html')
    (out / RESULTS).write_text(json.dumps(figures, indent=2) + '\n')
    sys.stdout.write(text_tables(figures) + f'\nreport  {out / "report.html"}\n')


def _sweeps(arguments: argparse.Namespace, cache: Path, bar: studies.Bar) -> StoredSweeps:
    name = ''.join(c if c.isalnum() else '_' for c in str(arguments.input)).strip('_')
    spacing, truth = arguments.spacing, arguments.truth
    kept = f'{name}_{arguments.sequence or ""}_{spacing:g}_{truth.stem if truth else ""}'
    if is_stored(cache / kept) and truth is None:
        return StoredSweeps(cache / kept)
    reference = None if truth is None else read_reference(truth)
    drive = drive_from(arguments)
    T_base_body = mounting_in_base(drive.mountings, arguments.truth_frame)
    total = sum(s.count for s in drive.streams() if s.type_name.endswith('PointCloud2'))
    with bar('reading sweeps', total) as step:
        return store_drive(
            drive,
            cache / kept,
            spacing_m=spacing,
            reference=reference,
            T_base_body=T_base_body,
            progress=lambda done, of: step(),
        )


def _methods(arguments: argparse.Namespace) -> Methods:
    methods = Methods(
        arguments.weights, device=arguments.device, full_intensity=arguments.full_intensity
    )
    # Built once here, so that a mistake shows before hours of work.
    for name in arguments.methods:
        methods.descriptor(name)
    for name in arguments.registration:
        methods.registration(name)
    return methods


def _study(
    arguments: argparse.Namespace,
    methods: Methods,
    sweeps: StoredSweeps,
    settings: RevisitConfig,
    bands: list[Band],
    cache: Path,
    bar: studies.Bar,
) -> Study:
    study = Study()
    views: dict[str, Sweeps] = {'whole': sweeps}
    for width in arguments.sector:
        views[f'sector_{width:g}'] = SectorRemoved(sweeps, width, arguments.draw)
    if arguments.rear_block:
        blocked = RearBlocked(sweeps, arguments.rear_block)
        views[f'rear_{arguments.rear_block:g}'] = blocked
        views[f'rear_{arguments.rear_block:g}_aggregated'] = Aggregated(blocked)
    if arguments.methods:
        study.detection = studies.study_detection(
            methods, arguments.methods, views, settings, folder=cache / 'descriptors', bar=bar
        )
    if not arguments.registration:
        return study
    if arguments.freiburg:
        study.pairs['icp'] = _confirmed_pairs(arguments, sweeps, bar)
    else:
        for band in bands:
            study.pairs[band.name] = choose_pairs(
                sweeps.T_world_base, band, settings, count=arguments.pairs, seed=arguments.draw
            )
    study.registration = studies.study_registration(
        methods, arguments.registration, sweeps, study.pairs, bar=bar
    )
    for view, blocked_sweeps in views.items():
        if view == 'whole' or not study.pairs:
            continue
        first = next(iter(study.pairs))
        study.pairs[f'{first}_{view}'] = study.pairs[first]
        study.registration |= studies.study_registration(
            methods,
            arguments.registration,
            blocked_sweeps,
            {f'{first}_{view}': study.pairs[first]},
            bar=bar,
        )
    return study


def _confirmed_pairs(arguments: argparse.Namespace, sweeps: StoredSweeps, bar: studies.Bar) -> Any:
    from lcd_loop_closure.evaluation.icp_pairs import IcpPairsConfig, drawn_pairs, icp_pairs

    drawn, _, _ = drawn_pairs(sweeps.T_world_base, IcpPairsConfig(), arguments.draw)
    with bar('confirming pairs by ICP', len(drawn)) as step:
        return icp_pairs(
            sweeps.T_world_base,
            sweeps.cloud,
            count=None if arguments.pairs is None else -(-arguments.pairs // 2),
            seed=arguments.draw,
            progress=step,
        )


def _figures(
    sweeps: StoredSweeps, settings: RevisitConfig, study: Study, arguments: argparse.Namespace
) -> dict[str, Any]:
    counted = count_revisits(sweeps.T_world_base, settings)
    return {
        'drive': {
            'name': sweeps.name,
            'input': str(arguments.input),
            'scans': counted.scans,
            'path_m': counted.length_m,
            'loops': counted.loops,
            'pairs': counted.pairs,
            'reverse_share': counted.reverse_share,
        },
        'settings': {
            **asdict(settings),
            'spacing_m': arguments.spacing,
            'seed': arguments.draw,
            'weights': None if arguments.weights is None else arguments.weights.name,
        },
        **study.plain(),
    }


def _band(text: str) -> Band:
    low, dash, high = text.partition('-')
    try:
        band = Band(float(low), float(high))
    except ValueError:
        dash = ''
    if not dash or not 0.0 <= band.low_m < band.high_m < np.inf:
        raise ConfigError(f'a band of distances is LOW-HIGH in metres, e.g. 4-10, got {text!r}')
    return band


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='evaluate_loops',
        description=__doc__,
        epilog=_EXAMPLES
        + _listed('methods', DESCRIPTORS)
        + _listed('registrations', REGISTRATIONS),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    add = parser.add_argument
    defaults = RevisitConfig()
    add('--out', type=Path, required=True, metavar='FOLDER', help='for the results')
    add('--methods', nargs='*', default=['lcdnet', 'scan_context'], metavar='NAME',
        choices=DESCRIPTORS, help='descriptors (default: lcdnet scan_context)')  # fmt: skip
    add('--registration', nargs='*', default=[], metavar='NAME', choices=REGISTRATIONS,
        help='registrations to judge (default: none)')  # fmt: skip
    add('--weights', type=Path, metavar='FILE', help='of LCDNet (default: those that ship)')
    add('--device', default='auto', help='auto, cpu or cuda (default: %(default)s)')
    add('--full-intensity', type=float, default=1.0, metavar='I',
        help='intensity of the brightest return; 0: none (default: %(default)g)')  # fmt: skip
    add('--pairs', type=_positive(int), metavar='N', help='register N pairs drawn at random')
    add('--bands', nargs='+', default=['0-4'], metavar='LOW-HIGH',
        help='distances of pairs to register, metres (default: 0-4)')  # fmt: skip
    add('--sector', nargs='*', type=_positive(float), default=[], metavar='DEG',
        help='judge sweeps without a random sector of this width too')  # fmt: skip
    add('--rear-block', type=_positive(float), metavar='DEG',
        help='judge sweeps blocked to the rear too, alone and with the metres before')  # fmt: skip
    add('--radius', type=_positive(float), default=defaults.distance, metavar='M',
        help='largest distance of two scans of one place (default: %(default)g)')  # fmt: skip
    add('--excluded', type=int, default=defaults.excluded_scans, metavar='N',
        help='scans just before one that do not count (default: %(default)d)')  # fmt: skip
    add('--first', type=int, default=defaults.first_scan, metavar='N',
        help='first scan that is asked (default: %(default)d)')  # fmt: skip
    add('--freiburg', action='store_true',
        help='10 m, 100 scans, and pairs that ICP confirms (thesis section 3.3.11)')  # fmt: skip
    add('--spacing', type=float, default=0.0, metavar='M',
        help='path between two sweeps at least (default: every sweep)')  # fmt: skip
    add('--truth', type=Path, metavar='FILE', help='reference poses: TUM or KITTI')
    add('--truth-frame', default='base_link', metavar='FRAME',
        help='frame whose poses they are (default: %(default)s)')  # fmt: skip
    add('--draw', type=int, default=0, metavar='N',
        help='seed of the random sectors and pairs (default: %(default)d)')  # fmt: skip
    add('--cache', type=Path, metavar='FOLDER', help='keep sweeps and descriptors for later runs')
    add('--quiet', action='store_true', help='show no progress')
    return parser


def _listed(title: str, names: dict[str, str]) -> str:
    width = max(map(len, names))
    lines = [f'  {name:<{width}}  {text}\n' for name, text in names.items()]
    return f'\n{title}:\n' + ''.join(lines)


def _positive(kind: Callable[[str], float]) -> Callable[[str], float]:
    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = -1
        if not 0 < value < 1e9:
            raise argparse.ArgumentTypeError(f'must be a number above zero, got {text!r}')
        return value

    return read


if __name__ == '__main__':
    sys.exit(main())
