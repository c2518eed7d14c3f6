"""Write the figures of a study as Markdown: Tables 5.1 to 5.4."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from cmrnet_ekf.calibration import AXES
from cmrnet_ekf.evaluation.measures import SHARE


def markdown(figures: Mapping[str, Any], pictures: Sequence[str] = ()) -> str:
    """Return all tables of `Study.plain`, and the pictures by name."""
    parts = [
        f'# CMRNet on {", ".join(figures["drives"])}\n\n{figures["samples"]} samples.\n',
        '## Localization, single pass (Table 5.1)\n\n' + localization(figures['localization']),
    ]
    if figures['refined']:
        parts.append('## Refined in stages\n\n' + _refined(figures))
    if figures['calibration']:
        parts.append('## Calibration error, mean ± std (Table 5.3)\n\n' + _calibration(figures))
        parts.append('## Sharpness and order\n\n' + _sharpness(figures))
        parts.append(
            f'## Without the top {SHARE:.0%} of either trace (Table 5.4)\n\n' + _rejection(figures)
        )
        parts.append('## Accuracy beside calibration (as Table 5.2)\n\n' + _both(figures))
    for name, found in figures['by_count'].items():
        parts.append(f'## {name} by its number of draws or members\n\n' + _counts(found))
    if figures['stretch']:
        parts.append('## The worst stretch (Fig. 5.6)\n\n' + _stretch(figures['stretch']))
    if pictures:
        parts.append('\n'.join(f'![{name}]({name})' for name in pictures) + '\n')
    return '\n'.join(parts)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; all columns but the first stand to the right."""
    lines = [header, ['---', *['---:'] * (len(header) - 1)], *rows]
    return ''.join('| ' + ' | '.join(line) + ' |\n' for line in lines)


def localization(found: Mapping[str, Mapping[str, float]]) -> str:
    """Return the table of errors."""
    header = ['', 't median [m]', 't mean ± std', 't p95', 'r median [°]', 'r mean ± std', 'r p95']
    return table([*header, '> 1 m', '> 4 m'], [[name, *_errors(e)] for name, e in found.items()])


def _errors(e: Mapping[str, float]) -> list[str]:
    return [
        f'{e["t_median_m"]:.3f}',
        f'{e["t_mean_m"]:.3f} ± {e["t_std_m"]:.3f}',
        f'{e["t_p95_m"]:.3f}',
        f'{e["r_median_deg"]:.2f}',
        f'{e["r_mean_deg"]:.2f} ± {e["r_std_deg"]:.2f}',
        f'{e["r_p95_deg"]:.2f}',
        f'{e["failures_1m"]:.1%}',
        f'{e["failures_4m"]:.1%}',
    ]


def _refined(figures: Mapping[str, Any]) -> str:
    rows = {
        f'{name}, {stage.replace("_", " ")}': errors
        for name, stages in figures['refined'].items()
        for stage, errors in stages.items()
    }
    return localization(rows)


def _calibration(figures: Mapping[str, Any]) -> str:
    names = list(figures['calibration'])
    return table(
        ['', *names],
        [
            [axis, *(
                f'{figures["calibration"][n][axis]:.3f} ± {figures["calibration_std"][n][axis]:.3f}'
                for n in names
            )]
            for axis in AXES
        ],
    )  # fmt: skip


def _sharpness(figures: Mapping[str, Any]) -> str:
    units = ['[m]'] * 3 + ['[rad]'] * 3
    header = ['', *(f'{axis} {unit}' for axis, unit in zip(AXES, units, strict=True))]
    rows = [
        [
            name,
            *(f'{found[axis]:.3g}' for axis in AXES),
            f'{figures["ause"][name]["translation"]:.3f}',
            f'{figures["ause"][name]["rotation"]:.3f}',
        ]
        for name, found in figures['sharpness'].items()
    ]
    return table([*header, 'AUSE t', 'AUSE r'], rows)


def _rejection(figures: Mapping[str, Any]) -> str:
    found = figures['rejection']
    header = ['', 't median [m]', 't mean ± std', 't p95', 'r median [°]', 'r mean ± std', 'r p95']
    limits = 'max_trace_translation', 'max_trace_rotation'
    rows = [
        [n, *_errors(e), f'{e["discarded_share"]:.1%}', *(f'{e[limit]:.3g}' for limit in limits)]
        for n, e in found.items()
    ]
    return table([*header, '> 1 m', '> 4 m', 'discarded', *limits], rows)


def _both(figures: Mapping[str, Any]) -> str:
    rows = []
    for name, found in figures['calibration'].items():
        e, spread = figures['localization'][name], figures['calibration_std'][name]
        parts = []
        for axes in (AXES[:3], AXES[3:]):
            mean, std = (sum(of[axis] for axis in axes) / 3.0 for of in (found, spread))
            parts.append(f'{mean:.3f} ± {std:.3f}')
        rows.append([
            name, f'{e["t_mean_m"]:.2f} ± {e["t_std_m"]:.2f}',
            f'{e["r_mean_deg"]:.1f} ± {e["r_std_deg"]:.1f}', *parts,
        ])  # fmt: skip
    return table(['', 't [m]', 'r [°]', 'calibration t', 'calibration r'], rows)


def _counts(found: Mapping[str, Mapping[str, float]]) -> str:
    columns = [('t_mean_m', 't mean [m]'), ('r_mean_deg', 'r mean [°]')]
    columns += [(f'calibration_{axis}', f'cal. {axis}') for axis in AXES]
    rows = [
        [count, *(f'{row[key]:.3f}' if key in row else '-' for key, _ in columns)]
        for count, row in found.items()
    ]
    return table(['number', *(label for _, label in columns)], rows)


def _stretch(found: Mapping[str, Any]) -> str:
    rows = [
        [
            name,
            f'{one["t_mean_m"]:.2f}',
            '-' if one['t_mean_kept_m'] is None else f'{one["t_mean_kept_m"]:.2f}',
            str(one['rejected']),
            f'{one["failures_1m_rejected"]} of {one["failures_1m"]}',
        ]
        for name, one in found['methods'].items()
    ]
    header = ['', 't mean [m]', 'of the kept', 'rejected', 'failures over 1 m rejected']
    return f'{found["frames"]} frames of {found["drive"]}.\n\n' + table(header, rows)
