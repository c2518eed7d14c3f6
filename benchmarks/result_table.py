"""A table of measured figures in markdown: what is shown of a result file, and how."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Cell:
    """Figures of a result file as they are written.

    Attributes:
        shown: a format string for the values, e.g. '{:.0f} / {:.0f} ms'.
        keys: dotted keys of the values in the result file; `a.*.b` is the mean of b over all
            groups of a.
        times: factor of the values, e.g. 100 for a share shown in percent.
    """

    shown: str
    keys: tuple[str, ...]
    times: float = 1.0

    def text(self, figures: Mapping[str, Any]) -> str:
        """Return the values; 'not measured' when one is missing."""
        values = [_value(figures, key.split('.')) for key in self.keys]
        known = [value * self.times for value in values if value is not None]
        return self.shown.format(*known) if len(known) == len(values) else 'not measured'


@dataclass(frozen=True)
class Row:
    """One row: what was measured, how it is written, and what was asked for.

    Attributes:
        what: for people.
        shown, keys, times: see Cell.
        asked: the limit, or empty.
    """

    what: str
    shown: str
    keys: tuple[str, ...]
    asked: str = ''
    times: float = 1.0

    def texts(self, figures: Mapping[str, Any]) -> list[str]:
        """Return every column."""
        return [self.what, Cell(self.shown, self.keys, self.times).text(figures), self.asked]


@dataclass(frozen=True)
class WideRow:
    """One row of a table with columns of its own: figures, or words where there are none."""

    what: str
    cells: tuple[Cell | str, ...]

    def texts(self, figures: Mapping[str, Any]) -> list[str]:
        """Return every column."""
        cells = [cell if isinstance(cell, str) else cell.text(figures) for cell in self.cells]
        return [self.what, *cells]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        results: name of the result file, without its ending.
        rows: from top to bottom, each with as many columns as the header.
        header: names of the columns.
        section: of the result file, when the table shows that one alone: its commit, date and
            machine are stated below.
    """

    results: str
    rows: Sequence[Row | WideRow]
    header: tuple[str, ...] = ('what', 'measured', 'asked')
    section: str = ''

    def markdown(self, figures: Mapping[str, Any]) -> str:
        """Return the table; what the figures lack is written as not measured."""
        lines = [f'| {" | ".join(self.header)} |', '|---' * len(self.header) + '|']
        lines += [f'| {" | ".join(row.texts(figures))} |' for row in self.rows]
        origin = self._origin(figures)
        return '\n'.join([*lines, *(['', origin] if origin else []), ''])

    def _origin(self, figures: Mapping[str, Any]) -> str:
        measured = figures.get('measured')
        at = measured.get(self.section) if isinstance(measured, Mapping) else None
        if not isinstance(at, Mapping):
            return ''
        quick = ' with --quick' if at.get('quick') else ''
        return f'Measured{quick} at commit `{at["commit"]}` on {at["date"]}: {at["machine"]}.'


def _value(figures: Any, parts: Sequence[str]) -> float | None:
    if not parts:
        is_number = isinstance(figures, int | float) and figures == figures
        return float(figures) if is_number else None
    if not isinstance(figures, Mapping):
        return None
    if parts[0] != '*':
        return _value(figures.get(parts[0]), parts[1:])
    values = [_value(group, parts[1:]) for group in figures.values()]
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None
