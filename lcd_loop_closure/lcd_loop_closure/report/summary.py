"""Say in a few lines how a drive went."""

from lcd_loop_closure.report.drive_evaluation import DriveEvaluation, start_to_end_m
from lcd_loop_closure.report.loop_evaluation import Verdict
from lcd_loop_closure.report.result import DriveResult


def summary(result: DriveResult, evaluation: DriveEvaluation) -> str:
    """Return the figures that matter, one a line, warnings last."""
    factor = result.realtime_factor
    lines = [
        f'{result.name}: {len(result.odometry)} of {len(result.scan_stamps_ns)} scans, '
        f'{len(result.keyframes)} keyframes, {evaluation.corrected.length_m:.0f} m'
        + ('' if factor is None else f', {factor:.1f} times real time'),
        f'loops      {len(result.accepted)} accepted of {len(result.loops)} candidates',
    ]
    loops = evaluation.loops
    if loops is not None:
        lines[-1] += f': {loops.count(Verdict.TRUE)} true, {loops.count(Verdict.FALSE)} false'
        if loops.recall is not None:
            revisits = len(loops.revisiting_stamps_ns)
            found = revisits - len(loops.missed_stamps_ns)
            lines.append(f'revisits   {found} of {revisits} found ({100 * loops.recall:.0f} %)')
    before, after = evaluation.before, evaluation.after
    if before is not None and after is not None:
        if before.ate_rmse_m is not None and after.ate_rmse_m is not None:
            lines.append(f'ATE        {before.ate_rmse_m:.3f} m -> {after.ate_rmse_m:.3f} m')
        lines.append(f'end error  {before.end_error_m:.3f} m -> {after.end_error_m:.3f} m')
    else:
        gaps = start_to_end_m(result.odometry), start_to_end_m(evaluation.corrected)
        lines.append(f'start-end  {gaps[0]:.3f} m -> {gaps[1]:.3f} m (no reference)')
    lines += [f'note       {warning}' for warning in evaluation.warnings]
    return '\n'.join(lines)
