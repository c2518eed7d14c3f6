"""Make runs of submaps: the command `make_submap_runs`."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lcd_common.command_line import run
from lcd_common.errors import ConfigError
from lcd_common.setting_changes import changed
from uncertain_place_recognition.datasets.benchmark import read_benchmark_run
from uncertain_place_recognition.datasets.recorded import run_of_drive, simulated_drive, world_of
from uncertain_place_recognition.datasets.regions import SITES, in_any_test_region
from uncertain_place_recognition.runs import SubmapRun, run_of_sweeps
from uncertain_place_recognition.submap import SubmapConfig, SubmapMaker

_EXAMPLES = """
examples:
  make_submap_runs --out runs/train town:0-15:0 town:0-15:1      two runs of each of 16 towns
  make_submap_runs --out runs/test town:200-203:0-4 --lidar vlp16 --length 5000
  make_submap_runs --out runs/test town:200:0-1 --style aliased
  make_submap_runs --out runs/kitti kitti/sequences/00 --spacing 2
  make_submap_runs --out runs/mulran MulRan/DCC01 MulRan/DCC02 --world DCC
  make_submap_runs --out runs/stored sweeps/town_0_reverse_run0    folders of stored sweeps
  make_submap_runs --out runs/near town:0-15:0-1 --submap reach=30 points=2048 ground=0.3
  make_submap_runs --out runs/oxford benchmark_datasets/oxford/2014-05-19-13-20-57 \\
      --benchmark pointcloud_20m
  make_submap_runs --out runs/oxford_train benchmark_datasets/oxford/* \\
      --benchmark pointcloud_20m_10overlap --outside oxford

Each source gives one file NAME.npz. Runs of the same world are searched in one another; drives of
one simulated town share a world, other drives have one each unless --world names it. For tests on
the benchmark make whole runs; evaluate_place_recognition --query-region asks in test regions only.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _make(arguments))


def _make(arguments: argparse.Namespace) -> None:
    settings = _settings(arguments)
    sources = [name for source in arguments.sources for name in _spelled_out(source)]
    for source in sources:
        with tqdm(unit='submap', desc=source[-40:], disable=arguments.quiet) as bar:
            made = _run_of(source, SubmapMaker(settings), arguments, bar)
        made = _with_facts(_of_regions(made, arguments), settings, arguments)
        if not len(made):
            sys.stdout.write(f'{source}: no submap is {made.facts["region"]}, left out\n')
            continue
        path = arguments.out / f'{made.name}.npz'
        made.save(path)
        sys.stdout.write(
            f'{path}: {len(made)} submaps, {made.length_m:.0f} m, world {made.world}\n'
        )


def _settings(arguments: argparse.Namespace) -> SubmapConfig:
    given = {'points': arguments.points, 'reach': arguments.reach}
    changes = [f'{name}={value}' for name, value in given.items() if value is not None]
    changes += arguments.submap
    if changes and arguments.benchmark is not None:
        raise ConfigError(
            f"the benchmark's submaps come made: leave out {', '.join(changes)}, or --benchmark"
        )
    if (arguments.outside or arguments.inside) and arguments.benchmark is None:
        raise ConfigError(
            'test regions are those of the benchmark: --outside wants --benchmark SET'
        )
    return changed(SubmapConfig(), changes)


def _of_regions(made: SubmapRun, arguments: argparse.Namespace) -> SubmapRun:
    """Return what lies in, or outside of, the test regions of the sites that were named."""
    sites = sorted(arguments.outside or arguments.inside)
    if not sites:
        return made
    inside = in_any_test_region(made.positions, sites)
    kept = made.select(np.flatnonzero(~inside if arguments.outside else inside))
    region = f'{"outside" if arguments.outside else "inside"} {" ".join(sites)}'
    return replace(kept, facts={**kept.facts, 'region': region})


def _run_of(source: str, maker: SubmapMaker, arguments: argparse.Namespace, bar: Any) -> SubmapRun:
    def progress(done: int, total: int) -> None:
        bar.total = total
        bar.update(done - bar.n)

    world = arguments.world or ''
    if source.startswith('town:'):
        _, seed, number = source.split(':')
        drive: Any = simulated_drive(
            int(seed),
            int(number),
            style=arguments.style,
            lidar=arguments.lidar,
            length_m=arguments.length,
        )
    elif arguments.benchmark is not None:
        return read_benchmark_run(Path(source), arguments.benchmark, world)
    elif (Path(source) / 'index.npz').is_file():
        from lcd_loop_closure.evaluation.drive_sweeps import spaced
        from lcd_loop_closure.evaluation.sweep_store import StoredSweeps

        sweeps = StoredSweeps(Path(source))
        sweeps = sweeps.select(spaced(sweeps.T_world_base, arguments.spacing))
        return run_of_sweeps(sweeps, maker.make, world or world_of(sweeps.name), progress)
    else:
        from bags.inputs import open_input

        drive = open_input(source)
    return run_of_drive(drive, maker, spacing_m=arguments.spacing, world=world, progress=progress)


def _with_facts(
    made: SubmapRun, settings: SubmapConfig, arguments: argparse.Namespace
) -> SubmapRun:
    if made.facts.get('normalisation') == 'benchmark':
        return made
    facts = {**made.facts, 'spacing_m': arguments.spacing, 'submap': asdict(settings)}
    return replace(made, facts=facts)


def _spelled_out(source: str) -> list[str]:
    """Return town:0-2:1 as town:0:1, town:1:1, town:2:1; anything else as it is."""
    if source.partition(':')[0] != 'town' or Path(source).exists():
        return [source]
    parts = [*source.split(':')[1:], '0']
    try:
        seeds, runs = (_numbers(part) for part in parts[:2])
    except ValueError:
        raise ConfigError(
            f'a simulated town is town:SEED or town:SEED:RUN, numbers or ranges A-B, got {source!r}'
        ) from None
    return [f'town:{seed}:{number}' for seed in seeds for number in runs]


def _numbers(text: str) -> range:
    first, dash, last = text.partition('-')
    return range(int(first), int(last if dash else first) + 1)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='make_submap_runs',
        description='Make runs of submaps with true poses.',
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('sources', nargs='+', help='town:SEEDS[:RUNS], a drive, stored sweeps, a benchmark run')
    add('--out', type=Path, required=True, help='folder for the runs')
    add('--spacing', type=float, default=2.0, help='path between two submaps, m (default: 2)')
    add('--world', help='name of the frame of the poses')
    add('--lidar', default='hdl64', help='of simulated towns (default: hdl64)')
    add('--style', default='', help='of simulated towns, e.g. aliased (default: a mixture)')
    add('--length', type=float, default=1500.0, help='of simulated drives, m (default: 1500)')
    add('--points', type=int, help='of a submap (default: 4096)')
    add('--reach', type=float, help='half the width of a submap, m (default: 50)')
    add(
        '--submap', nargs='+', default=[], metavar='NAME=VALUE',
        help='how sweeps become submaps: ' + ', '.join(one.name for one in fields(SubmapConfig)),
    )  # fmt: skip
    add('--benchmark', metavar='SET', help='sources are runs of the PointNetVLAD benchmark')
    region = parser.add_mutually_exclusive_group()
    for name, text in (
        ('outside', "leave out the benchmark's test regions of a site, for training"),
        ('inside', 'keep these alone, to validate such a training'),
    ):
        region.add_argument(
            f'--{name}', action='append', default=[], choices=SITES, help=f'{text}; may be repeated'
        )
    add('--quiet', action='store_true', help='no progress bar')
    return parser


if __name__ == '__main__':
    raise SystemExit(main())
