"""Write one page, and one table in text, that tell how an evaluation went."""

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from lcd_loop_closure.evaluation.figures import Picture, pairs_title, view_title

_TEMPLATE = Path(__file__).with_name('page.html')
_CLASSES = (('all', 'all'), ('same_way', 'same way'), ('reverse', 'reverse'))


def write_page(figures: Mapping[str, Any], pictures: Sequence[Picture], path: Path) -> None:
    """Write the page with its pictures inside it.

    Args:
        figures: what results.json holds.
        pictures: shown in their order.
        path: of the page.
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    page = environment.from_string(_TEMPLATE.read_text()).render(
        drive=figures['drive'],
        settings=figures['settings'],
        tables=[*detection_tables(figures), *registration_tables(figures)],
        pictures=[
            {
                'title': picture.title,
                'caption': picture.caption,
                'data': base64.b64encode(picture.path.read_bytes()).decode(),
            }
            for picture in pictures
        ],
    )
    path.write_text(page)


def text_tables(figures: Mapping[str, Any]) -> str:
    """Return all tables as aligned text."""
    parts = []
    for table in (*detection_tables(figures), *registration_tables(figures)):
        rows = [table['columns'], *table['rows']]
        widths = [max(len(row[k]) for row in rows) for k in range(len(table['columns']))]
        lines = [
            '  '.join(
                cell.ljust(width) if k == 0 else cell.rjust(width)
                for k, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        ]
        notes = [f'{name}: {why}' for name, why in table['missing']]
        parts.append('\n'.join([table['title'], *lines, *notes]))
    return '\n\n'.join(parts) + '\n'


def detection_tables(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a table for each view: title, columns, rows of text, and what is missing and why."""
    tables = []
    for view, methods in figures['detection'].items():
        columns = ['method']
        columns += [f'AP {protocol}, {title}' for protocol in (1, 2) for _, title in _CLASSES]
        columns += ['F1 max', 'recall@1', 'ms/sweep']
        rows, missing = [], []
        for name, one in methods.items():
            if 'missing' in one:
                missing.append((name, one['missing']))
                continue
            cells = [name]
            for protocol in ('protocol_1', 'protocol_2'):
                for kind, _ in _CLASSES:
                    cells.append(_number((one[protocol][kind] or {}).get('average_precision')))
            best = (one['protocol_1']['all'] or {}).get('f1_max')
            cells += [_number(best), _number(one['recall_1']), _number(one['describe_ms'], 1)]
            rows.append(cells)
        tables.append(
            {
                'title': f'Loop detection: {view_title(view)}',
                'columns': columns,
                'rows': rows,
                'missing': missing,
            }
        )
    return tables


def registration_tables(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a table for each kind of pairs."""
    tables = []
    for kind, result in figures['registration'].items():
        columns = [
            'method', 'success (heading)', '95 %', 'success (rotation)', 'TE m', 'TE m, all',
            'RE deg', 'RE deg, all', 'yaw deg', 'ms/pair',
        ]  # fmt: skip
        rows, missing = [], []
        for name, one in result['methods'].items():
            if 'missing' in one:
                missing.append((name, one['missing']))
                continue
            interval = one['success_interval']
            rows.append(
                [
                    name,
                    _percent(one['success']),
                    '–' if interval is None else '–'.join(_percent(v)[:-2] for v in interval),
                    _percent(one.get('success_full')),
                    _number(one.get('te_m')),
                    _number(one.get('te_m_all')),
                    _number(one.get('re_deg')),
                    _number(one.get('re_deg_all')),
                    _number(one.get('yaw_deg')),
                    _number(one['register_ms'], 0),
                ]
            )
        tables.append(
            {
                'title': f'Registration: {result["pairs"]} pairs {pairs_title(kind)} '
                f'(of {result["pairs_to_draw_from"]})',
                'columns': columns,
                'rows': rows,
                'missing': missing,
            }
        )
    return tables


def _number(value: float | None, digits: int = 3) -> str:
    return '–' if value is None else f'{value:.{digits}f}'


def _percent(value: float | None) -> str:
    return '–' if value is None else f'{100 * value:.1f} %'
