"""Write the figures of an evaluation as text."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_FAILURE = (
    ('auroc', 'AUROC'), ('aupr_in', 'AuPR-in'), ('aupr_out', 'AuPR-out'), ('aurc', 'AURC'),
    ('excess_aurc', 'E-AURC'), ('fpr95', 'FPR95'), ('recall_at_p99', 'R@P99'),
    ('recall_at_p100', 'R@P100'),
)  # fmt: skip


def text_tables(figures: Mapping[str, Any]) -> str:
    """Return all tables of `Study.plain`."""
    parts = [_recall(figures['recall']), _failure(figures['failure'])]
    parts.append(_interchange(figures['interchange']))
    if figures.get('probability'):
        found = figures['probability']
        parts.append(
            f'probability of a wrong match: ECE {found["ece"]:.3f}, Brier {found["brier"]:.3f}\n'
        )
    return '\n'.join(part for part in parts if part)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return lines with columns of equal width: the first to the left, others to the right."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    return ''.join(
        '  '.join(
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        + '\n'
        for line in lines
    )


def _recall(found: Mapping[str, Any]) -> str:
    """Table 4.3: recall in per cent, and differences from the first method, in points."""
    if not found:
        return 'no query has its place in a database: there is no recall\n'
    first = next(iter(found))
    rows = []
    for name, one in found.items():
        ends = '' if one['r1_low'] is None else f'{_cent(one["r1_low"])}-{_cent(one["r1_high"])}'
        row = [name, *(_cent(one[key]) for key in ('r1', 'r5', 'r10', 'one_percent')), ends]
        row += [f'{100 * (one[key] - found[first][key]):+.1f}' for key in ('r1', 'r5', 'r10')]
        rows.append(row)
    header = ['recall [%]', 'R@1', 'R@5', 'R@10', 'R@1%', 'R@1 95 %']
    return table([*header, *(f'd{key} {first}' for key in ('R@1', 'R@5', 'R@10'))], rows)


def _failure(found: Mapping[str, Any]) -> str:
    if not found:
        return ''
    rows = []
    for name, one in found.items():
        ends = '' if one['auroc_low'] is None else f'{one["auroc_low"]:.3f}-{one["auroc_high"]:.3f}'
        row = [name, _cent(one['base_rate']), *(_number(one[key]) for key, _ in _FAILURE), ends]
        rows.append(row)
    header = ['failure detection', 'wrong %', *(text for _, text in _FAILURE), 'AUROC 95 %']
    return table(header, rows)


def _interchange(found: Mapping[str, Any]) -> str:
    if not found:
        return ''
    rows = [
        [name, *(_cent(one[key]) for key in ('diagonal_r1', 'off_diagonal_r1', 'chance_r1'))]
        for name, one in found.items()
    ]
    return table(['interchange, R@1 [%]', 'same member', 'others', 'chance'], rows)


def _cent(share: float | None) -> str:
    return '-' if share is None else f'{100.0 * share:.1f}'


def _number(value: float | None) -> str:
    return '-' if value is None else f'{value:.3f}'
