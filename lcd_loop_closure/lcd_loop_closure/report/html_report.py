"""Write one page that tells how a drive went: pictures inside it, nothing loaded from elsewhere."""

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from lcd_loop_closure.report.drive_evaluation import DriveEvaluation
from lcd_loop_closure.report.figures import Picture
from lcd_loop_closure.report.loop_evaluation import JudgedLoop, Verdict
from lcd_loop_closure.report.result import DriveResult

_TEMPLATE = Path(__file__).with_name('report.html')
_MOST_ROWS = 300
# What is shown of a trajectory's errors: key, what it is, unit.
_ERROR_ROWS = (
    ('ate_rmse_m', 'Absolute error, RMSE (aligned)', 'm'),
    ('ate_median_m', 'Absolute error, median (aligned)', 'm'),
    ('ate_max_m', 'Absolute error, largest (aligned)', 'm'),
    ('ate_rotation_rmse_deg', 'Absolute rotation error, RMSE (aligned)', '°'),
    ('first_pose_ate_rmse_m', 'Absolute error, RMSE (first poses laid on one another)', 'm'),
    ('rpe_100m_rmse_m', 'Relative error over 100 m, RMSE', 'm'),
    ('drift_percent', 'Drift over 100 to 800 m, translation', '%'),
    ('drift_deg_per_100m', 'Drift over 100 to 800 m, rotation', '°/100 m'),
    ('end_error_m', 'Error of the last pose seen from the first', 'm'),
    ('end_error_deg', 'Rotation error of the last pose', '°'),
)


def write_html(
    result: DriveResult,
    evaluation: DriveEvaluation,
    figures: Mapping[str, Any],
    pictures: tuple[Picture, ...],
    path: Path,
) -> None:
    """Write the report.

    Args:
        result: of the drive.
        evaluation: of the same drive.
        figures: as `drive_evaluation.metrics` gives them.
        pictures: shown in their order, inlined.
        path: of the page.
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters['figure'] = figure
    template = environment.from_string(_TEMPLATE.read_text())
    accepted_first = sorted(evaluation.judged, key=_rank)
    page = template.render(
        drive=figures['drive'],
        headline=_headline(figures),
        warnings=evaluation.warnings,
        errors=_error_rows(figures),
        start_to_end=figures['start_to_end_m'],
        loops=figures['loops'],
        judged=evaluation.loops is not None,
        loop_rows=[_loop_row(j) for j in accepted_first[:_MOST_ROWS]],
        more_loops=max(len(accepted_first) - _MOST_ROWS, 0),
        stages=figures['stages_ms'],
        counts=figures['counts'],
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


def figure(value: object, digits: int = 3) -> str:
    """Return a number as people write it: three significant digits, a dash for what is unknown."""
    if value is None:
        return '–'
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if isinstance(value, int):
        return f'{value:,}'
    if value == 0 or abs(value) >= 10 ** (digits - 1):
        return f'{value:,.0f}'
    return f'{value:#.{digits}g}' if abs(value) >= 1e-3 else f'{value:.1e}'


def _headline(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the few figures that a reader looks for first: (value, what it is)."""
    before, after, loops = figures['before'], figures['after'], figures['loops']
    tiles = [(f'{figure(figures["drive"]["path_m"])} m', 'driven')]
    if after is not None:
        key = 'ate_rmse_m' if after['ate_rmse_m'] is not None else 'first_pose_ate_rmse_m'
        tiles.append((f'{figure(before[key])} → {figure(after[key])} m', 'absolute error, RMSE'))
        tiles.append(
            (f'{figure(before["end_error_m"])} → {figure(after["end_error_m"])} m', 'end error')
        )
    else:
        gap = figures['start_to_end_m']
        tiles.append((f'{figure(gap["before"])} → {figure(gap["after"])} m', 'from start to end'))
    tiles.append((f'{loops["accepted"]} of {loops["candidates"]}', 'loop candidates accepted'))
    if loops.get('precision') is not None:
        tiles.append((f'{100 * loops["precision"]:.0f} %', 'of the accepted loops are true'))
    if loops.get('recall') is not None:
        tiles.append((f'{100 * loops["recall"]:.0f} %', 'of the revisits found'))
    if figures['drive']['realtime_factor'] is not None:
        tiles.append((f'{figure(figures["drive"]["realtime_factor"])} ×', 'real time'))
    return tiles


def _error_rows(figures: Mapping[str, Any]) -> list[tuple[str, str, object, object]]:
    before, after = figures['before'], figures['after']
    if before is None or after is None:
        return []
    return [(name, unit, before[key], after[key]) for key, name, unit in _ERROR_ROWS]


def _rank(j: JudgedLoop) -> tuple[int, int]:
    order = (Verdict.FALSE, Verdict.TRUE, Verdict.UNKNOWN, Verdict.REJECTED)
    return order.index(j.verdict), j.loop.query_stamp_ns


def _loop_row(j: JudgedLoop) -> dict[str, object]:
    loop = j.loop
    status = loop.status.name.lower().removeprefix('rejected_').replace('_', ' ')
    return {
        'verdict': j.verdict.value,
        'pair': f'{loop.query_id} → {loop.match_id}',
        'status': status,
        'fitness': loop.fitness,
        'overlap': loop.overlap,
        'descriptor_distance': loop.descriptor_distance,
        'apart_m': j.apart_m,
        'translation_error_m': j.translation_error_m,
        'rotation_error_deg': j.rotation_error_deg,
        'reason': loop.reason or loop.method,
    }
