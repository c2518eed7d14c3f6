"""Keep measured figures: nested plain keys in JSON with commit, machine and date, and a table."""

import datetime
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.recordings import RESULTS, ROOT

# What benchmarks write: it changes no figure.
_WRITTEN = ('benchmarks/results', 'docs/images')


def commit(root: Path = ROOT) -> str:
    """Return the commit of a working tree; it ends in -dirty when what is measured is not of it."""
    name = _git(root, 'describe', '--always', '--abbrev=12')
    excluded = [f':(top,exclude){folder}' for folder in _WRITTEN]
    changed = _git(root, 'status', '--porcelain', '--', ':(top)', *excluded)
    return f'{name or "unknown"}{"-dirty" if changed else ""}'


def provenance() -> dict[str, str | int]:
    """Return commit, machine and date of a measurement."""
    model = next(
        (
            line.split(':')[1].strip()
            for line in Path('/proc/cpuinfo').read_text().splitlines()
            if line.startswith('model name')
        ),
        platform.processor(),
    )
    return {
        'commit': commit(),
        'date': datetime.date.today().isoformat(),
        'machine': f'{model}, {os.cpu_count()} cores',
        'python': platform.python_version(),
    }


def flatten(figures: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield (dotted key, value) of nested figures."""
    for key, value in figures.items():
        name = f'{prefix}.{key}' if prefix else key
        if isinstance(value, Mapping):
            yield from flatten(value, name)
        else:
            yield name, value


def missing(figures: Mapping[str, Any], required: tuple[str, ...]) -> list[str]:
    """Return the required dotted keys that have no figure; `a.*` asks for anything below a."""
    known = {key for key, value in flatten(figures) if value is not None}
    return [
        key
        for key in required
        if key not in known
        and not (key.endswith('.*') and any(k.startswith(key[:-1]) for k in known))
    ]


def merge(old: dict[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return `old` with every group of `new` replaced as a whole."""
    return {**old, **new}


def write(name: str, figures: Mapping[str, Any]) -> Path:
    """Write benchmarks/results/<name>.json with the provenance of this run."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f'{name}.json'
    path.write_text(json.dumps(_rounded(figures), indent=2) + '\n')
    return path


def read(name: str) -> dict[str, Any]:
    """Return the figures of an earlier run, or an empty dict."""
    path = RESULTS / f'{name}.json'
    figures: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    return figures


def print_table(figures: Mapping[str, Any]) -> None:
    """Print every figure on a line of its own."""
    rows = list(flatten(figures))
    width = max((len(key) for key, _ in rows), default=0)
    for key, value in rows:
        shown = f'{value:.6g}' if isinstance(value, float) else str(value)
        sys.stdout.write(f'{key:<{width}}  {shown}\n')


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(['git', *arguments], cwd=root, capture_output=True, text=True)
    return done.stdout.strip()


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_rounded(inner) for inner in value]
    return float(f'{value:.6g}') if isinstance(value, float) else value
