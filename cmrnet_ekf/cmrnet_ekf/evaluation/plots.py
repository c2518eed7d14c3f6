"""Draw what a study found: Figs. 5.3 to 5.6."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from cmrnet_ekf.calibration import AXES, calibration
from cmrnet_ekf.evaluation.figure import colours, figure, panels
from cmrnet_ekf.evaluation.measures import SHARE, by_confidence, by_count
from cmrnet_ekf.evaluation.stretch import Stretch
from cmrnet_ekf.evaluation.study import Study

_PANEL = 4.2
_ERROR_SCALE_M = 2.0  # colours of the stretch end there


def write_pictures(study: Study, folder: Path) -> list[Path]:
    """Draw all that a study has; return the files."""
    written = [_errors(study, folder / 'errors.png')]
    if study.knowing:
        written.append(_calibration(study, folder / 'calibration.png'))
        written.append(_rejection(study, folder / 'rejection.png'))
    if any(one.draws is not None for one in study.answers.values()):
        written.append(_counts(study, folder / 'counts.png'))
    if study.stretch is not None:
        written.append(_stretch(study.stretch, folder / 'stretch.png'))
    return written


def _errors(study: Study, path: Path) -> Path:
    """How many errors are smaller than so much."""
    colour = colours(list(study.answers))
    with figure(path, (10.0, 4.2)) as canvas:
        axes = canvas.subplots(1, 2)
        for name, one in study.answers.items():
            metres, radians = one.errors
            for ax, values in zip(axes, (metres, np.rad2deg(radians)), strict=True):
                share = np.arange(1, len(values) + 1) / len(values)
                ax.plot(np.sort(values), share, color=colour[name], label=name)
        for ax, unit in zip(
            axes, ('translation error [m]', 'rotation error [degrees]'), strict=True
        ):
            ax.set(xlabel=unit, ylabel='share of samples', ylim=(0, 1), xlim=(0, None))
        axes[0].set_title('Errors of a single pass')
        axes[0].legend()
    return path


def _calibration(study: Study, path: Path) -> Path:
    """Figs. 5.3 and 5.4, of all components."""
    colour = colours(list(study.answers))
    curves = {name: calibration(one.belief, one.target) for name, one in study.knowing.items()}
    with figure(path, (3 * 3.4, 2 * 3.5)) as canvas:
        for ax, axis in zip(canvas.subplots(2, 3).ravel(), AXES, strict=True):
            ax.plot([0, 1], [0, 1], color='0.6', lw=1, ls=(0, (4, 4)))
            for name, of_axis in curves.items():
                curve = of_axis[axis]
                label = f'{name} {curve.mean_error:.3f}'
                ax.plot(curve.expected, curve.observed, color=colour[name], lw=1.8, label=label)
            ax.set(xlim=(0, 1), ylim=(0, 1), xlabel='expected confidence')
            ax.set_ylabel('observed confidence')
            ax.set_title(axis)
            ax.set_aspect('equal')
            ax.legend(fontsize=8, title='mean error', title_fontsize=8)
    return path


def _rejection(study: Study, path: Path) -> Path:
    """Fig. 5.5: errors of what is kept against the top share that is discarded."""
    colour = colours(list(study.answers))
    with figure(path, (10.0, 4.2)) as canvas:
        axes = canvas.subplots(1, 2)
        for name, one in study.knowing.items():
            found = by_confidence(one)
            for ax, key in zip(axes, ('t_mean_m', 'r_mean_deg'), strict=True):
                ax.plot(found['top_share'], found[key], color=colour[name], label=name)
        for ax, unit in zip(axes, ('[m]', '[degrees]'), strict=True):
            ax.set(xlabel='top share of either trace discarded', ylim=(0, _above(ax)))
            ax.axvline(SHARE, color='0.6', lw=1, ls=(0, (4, 4)))
            ax.set_ylabel(f'mean error of the rest {unit}')
        axes[0].set_title('Translation')
        axes[1].set_title('Rotation')
        axes[0].legend()
    return path


def _counts(study: Study, path: Path) -> Path:
    """What more draws or members bring."""
    colour = colours(list(study.answers))
    panels = (
        ('t_mean_m', 'mean translation error [m]'),
        ('r_mean_deg', 'mean rotation error [degrees]'),
        ('calibration', 'mean calibration error, x y yaw'),
    )
    with figure(path, (3 * _PANEL, 3.8)) as canvas:
        axes = canvas.subplots(1, 3)
        for name, one in study.answers.items():
            if one.draws is None:
                continue
            found = by_count(one)
            for row in found.values():
                values = [row.get(f'calibration_{axis}', np.nan) for axis in ('x', 'y', 'yaw')]
                row['calibration'] = float(np.mean(values))
            at = [int(count) for count in found]
            for ax, (key, _) in zip(axes, panels, strict=True):
                ax.plot(at, [r[key] for r in found.values()], '.-', color=colour[name], label=name)
        for ax, (_, label) in zip(axes, panels, strict=True):
            ax.set(xlabel='draws (MCD), members (DE)', ylabel=label, xscale='log')
            ax.set_ylim(0, _above(ax))
            ax.set_xticks([2, 5, 10, 30, 100], ['2', '5', '10', '30', '100'])
        axes[0].legend()
    return path


def _stretch(stretch: Stretch, path: Path) -> Path:
    """Fig. 5.6: where each method put the frames; what it rejected is grey and hollow."""
    with panels(path, len(stretch.located), 4, (_PANEL, _PANEL)) as (canvas, axes):
        shown = None
        for ax, (name, one) in zip(axes, stretch.located.items(), strict=True):
            ax.plot(*stretch.truth.T, color='0.75', lw=5, zorder=1)
            gone = one.positions[~one.kept]
            ax.scatter(*gone.T, s=14, facecolors='none', edgecolors='0.5', lw=0.8, zorder=2)
            shown = ax.scatter(
                *one.positions[one.kept].T, c=one.metres[one.kept], s=10, cmap='plasma_r',
                vmin=0.0, vmax=_ERROR_SCALE_M, zorder=3,
            )  # fmt: skip
            ax.set_aspect('equal', 'datalim')
            rejected = f', {len(gone)} rejected' if len(gone) else ''
            ax.set_title(f'{name}: {one.metres[one.kept].mean():.2f} m{rejected}'
                         if one.kept.any() else f'{name}: all rejected')  # fmt: skip
            ax.set_xlabel('x [m]')
        axes[0].set_ylabel('y [m]')
        if shown is not None:
            canvas.colorbar(shown, ax=axes, label='translation error [m]')
    return path


def _above(ax: Axes) -> float:
    """Return a limit above all lines of finite values."""
    values = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in ax.lines])
    finite = values[np.isfinite(values)]
    return 1.1 * float(finite.max()) if finite.size else 1.0
