"""One command for the numbers of a part: sections that are measured, kept and shown."""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import report
from lcd_common.command_line import run
from lcd_common.errors import LocalizationError

Section = Callable[[Path], dict[str, Any]]


@dataclass(frozen=True)
class Benchmark:
    """A command of this kind.

    Attributes:
        name: of benchmarks/<name>.py and of benchmarks/results/<name>.json.
        text: what --help says.
        sections: `sections(quick)` gives every section by name: what it measures, and the function
            that does; it gets a folder for intermediate files.
        required: dotted keys without which the command fails; `a.*` is anything below a.
        place: `place(figures, section, new)` puts a section's figures among those there are.
    """

    name: str
    text: str
    sections: Callable[[bool], dict[str, tuple[str, Section]]]
    required: tuple[str, ...]
    place: Callable[[dict[str, Any], str, dict[str, Any]], Mapping[str, Any]]


def run_benchmark(benchmark: Benchmark, argv: Sequence[str] | None = None) -> int:
    """Run a command; return 1 when a section failed or a required figure is missing."""
    parser = argparse.ArgumentParser(
        prog=f'python -m benchmarks.{benchmark.name}',
        description=benchmark.text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--only', nargs='+', metavar='SECTION', help='measure only these')
    parser.add_argument('--list', action='store_true', help='list the sections and stop')
    parser.add_argument(
        '--quick', action='store_true', help='shorter, and marked so in the results'
    )
    parser.add_argument('--work', type=Path, help='folder for intermediate files, kept')
    arguments = parser.parse_args(argv)
    return run(lambda: _run(benchmark, arguments))


def _run(benchmark: Benchmark, arguments: argparse.Namespace) -> int:
    known = benchmark.sections(arguments.quick)
    if arguments.list:
        for name, (text, _) in known.items():
            print(f'{name:<19}{text}')
        return 0
    unknown = sorted(set(arguments.only or ()) - set(known))
    if unknown:
        raise LocalizationError(f'no section {", ".join(unknown)}; there are {", ".join(known)}')
    chosen = [name for name in known if not arguments.only or name in arguments.only]
    with tempfile.TemporaryDirectory(prefix=f'{benchmark.name}_benchmark_') as temporary:
        work = arguments.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        only = {name: known[name][1] for name in chosen}
        failures = measure(benchmark, only, work, arguments.quick)
    figures = report.read(benchmark.name)
    report.print_table(figures)
    absent = report.missing(figures, benchmark.required)
    for name, error in failures.items():
        print(f'could not run {name}: {error}', file=sys.stderr)
    if absent:
        print(f'missing figures: {", ".join(absent)}', file=sys.stderr)
    return 1 if failures or absent else 0


def measure(
    benchmark: Benchmark, chosen: dict[str, Section], work: Path, quick: bool = False
) -> dict[str, str]:
    """Run sections one by one, keeping each one's figures at once; return what failed, and why."""
    failures = {}
    for number, (name, section) in enumerate(chosen.items(), start=1):
        print(f'[{number}/{len(chosen)}] {name} ...', file=sys.stderr, flush=True)
        start = time.perf_counter()
        try:
            new = section(work)
        except (LocalizationError, OSError, AssertionError, RuntimeError, ImportError) as error:
            failures[name] = f'{type(error).__name__}: {error}'
            continue
        seconds = time.perf_counter() - start
        figures = dict(benchmark.place(report.read(benchmark.name), name, new))
        measured = {**report.provenance(), 'seconds': round(seconds, 1), 'quick': quick}
        figures['measured'] = {**figures.get('measured', {}), name: measured}
        report.write(benchmark.name, figures)
    return failures
