"""What the tables about CMRNet and the EKF show of benchmarks/results/cmrnet_ekf.json."""

from collections.abc import Mapping

from benchmarks.result_table import Cell, Row, Table, WideRow

_WAYS = {'rough': 'the guesses', 'cmrnet': 'CMRNet', 'mcd': 'MC dropout', 'de': 'deep ensemble',
         'der': 'evidential regression'}  # fmt: skip
_OF_UNCERTAIN = {way: _WAYS[way] for way in ('mcd', 'de', 'der')}
_LOSSES = {'der_thesis': "thesis's L^D, in metres and radians", 'nll': 'negative log-likelihood',
           'covariance': 'Gaussian, full covariance'}  # fmt: skip
_UNCERTAIN = (*_OF_UNCERTAIN, *_LOSSES)
_REFINED = {way: _WAYS[way] for way in ('cmrnet', 'der')}
_TRACKED = {
    'motion': "thesis's motion model alone",
    'inertial': 'IMU and wheels alone',
    'unfiltered': 'motion model, CMRNet without a filter',
    'mcd': 'EKF, MC dropout',
    'de': 'EKF, deep ensemble',
    'der': 'EKF, evidential regression',
    'refined.der': '— in stages (what `map_registration` does)',
    'towns.der': '— in stages, three other towns of 600 m',
    'thesis.mcd': "thesis's filter, MC dropout",
    'thesis.de': "thesis's filter, deep ensemble",
    'thesis.der': "thesis's filter, evidential regression",
}
_LOST = ('motion', 'unfiltered', 'thesis.mcd', 'thesis.de', 'thesis.der')


def _localized(way: str, what: str) -> WideRow:
    errors = f'localization.{way}'
    cells: tuple[Cell | str, ...] = (
        Cell('{:.2f} / {:.2f} m', (f'{errors}.t_median_m', f'{errors}.t_mean_m')),
        Cell('{:.2f}°', (f'{errors}.r_median_deg',)),
        Cell('{:.1f} %', (f'{errors}.failures_1m',), 100),
    )
    if way not in _UNCERTAIN:
        return WideRow(what, (*cells, '', ''))
    calibrated = tuple(f'calibration.{way}.{axis}' for axis in ('x', 'y', 'yaw'))
    return WideRow(
        what,
        (
            *cells,
            Cell('{:.3f} / {:.3f} / {:.3f}', calibrated),
            Cell('{:.2f} m', (f'rejection.{way}.t_mean_m',)),
        ),
    )


def _single_pass(title: str, ways: Mapping[str, str]) -> Table:
    columns = (
        title,
        'error, median / mean',
        'rotation',
        'off by more than 1 m',
        'calibration error x / y / yaw',
        'mean error when the unsure are rejected',
    )
    rows = tuple(_localized(*way) for way in ways.items())
    return Table('cmrnet_ekf', rows, columns, 'localization')


def _calibrated(way: str, what: str) -> WideRow:
    errors = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
    return WideRow(
        what,
        (
            *(Cell('{:.3f}', (f'calibration.{way}.{axis}',)) for axis in errors),
            Cell('{:.2f}', (f'calibration.ause.{way}.translation',)),
        ),
    )


def _rejected(way: str, what: str) -> WideRow:
    kept = f'rejection.{way}'
    return WideRow(
        what,
        (
            Cell('{:.2f} m', (f'localization.{way}.t_mean_m',)),
            Cell('{:.2f} m', (f'{kept}.t_mean_m',)),
            Cell('{:.2f}°', (f'localization.{way}.r_mean_deg',)),
            Cell('{:.2f}°', (f'{kept}.r_mean_deg',)),
            Cell('{:.1f} %', (f'{kept}.discarded_share',), 100),
        ),
    )


def _refined(way: str, what: str) -> WideRow:
    refined = f'localization.refined.{way}'
    stages = (f'localization.{way}', *(f'{refined}.after_stage_{stage}' for stage in (2, 3)))
    return WideRow(
        what,
        tuple(
            Cell('{:.2f} m, {:.2f}°', (f'{stage}.t_median_m', f'{stage}.r_median_deg'))
            for stage in stages
        ),
    )


def _held(way: str, what: str) -> WideRow:
    figures = f'ekf.{way}'
    return WideRow(
        what,
        (
            *(
                Cell('{:.2f}' + unit, (f'{figures}.{key}',))
                for key, unit in (
                    ('t_median_m', ' m'), ('t_mean_m', ' m'), ('t_max_m', ' m'),
                    ('r_median_deg', '°'),
                )
            ),
            # Of a vehicle that is lost it says nothing.
            '' if way in _LOST else Cell('{:.1f}', (f'{figures}.nees_mean',)),
            Cell('{:.0f} of {:.0f}', (f'{figures}.diverged', f'{figures}.runs')),
        ),
    )  # fmt: skip


LOCALIZATION_TABLES = {
    'cmrnet': _single_pass('single pass', _WAYS),
    'cmrnet_losses': _single_pass('Table 5.2, single pass', _LOSSES),
    'cmrnet_calibration': Table(
        'cmrnet_ekf',
        tuple(_calibrated(*way) for way in {**_OF_UNCERTAIN, **_LOSSES}.items()),
        ('calibration error', 'x', 'y', 'z', 'roll', 'pitch', 'yaw', 'AUSE of translation'),
        'calibration',
    ),
    'cmrnet_rejection': Table(
        'cmrnet_ekf',
        tuple(_rejected(*way) for way in _OF_UNCERTAIN.items()),
        ('the most uncertain rejected', 'mean error', 'of those kept', 'rotation, mean',
         'of those kept', 'discarded'),
        'rejection',
    ),
    'cmrnet_refined': Table(
        'cmrnet_ekf',
        tuple(_refined(*way) for way in _REFINED.items()),
        ('in stages, median', 'single pass', 'and the second network', 'and the third'),
        'localization',
    ),
    'tracking': Table(
        'cmrnet_ekf',
        tuple(_held(*way) for way in _TRACKED.items()),
        ('closed loop', 'median', 'mean', 'largest', 'rotation, median', 'NEES of 6', 'lost'),
        'ekf',
    ),
    'ekf': Table('cmrnet_ekf', (
        Row('Closed loop, 1.2 km, no satellites, wrong starts, DER in stages: median error',
            '{:.2f} m', ('ekf.refined.der.t_median_m',), '≤ 0.32 m'),
        Row('— single pass', '{:.2f} m', ('ekf.der.t_median_m',), '≤ 0.32 m'),
        Row("— lost, of 20 runs each: in stages / single pass / single pass, thesis's filter",
            '{:.0f} / {:.0f} / {:.0f}',
            ('ekf.refined.der.diverged', 'ekf.der.diverged', 'ekf.thesis.der.diverged'), '0'),
        Row('Epochs with ANEES inside the 95 % band, groups of 50 runs', '{:.1f} %',
            ('consistency.anees_inside_share',), '≥ 90 %', 100),
        Row("— with CMRNet's own errors, 50 stretches of 8 s", '{:.1f} %',
            ('consistency.with_cmrnet.as_told.anees_inside_share',), '≥ 90 %', 100),
        Row("Mean NEES of a pose / with CMRNet's own errors", '{:.2f} / {:.2f}',
            ('consistency.anees_mean', 'consistency.with_cmrnet.as_told.anees_mean'), '6'),
        Row('NIS of camera / wheels / GNSS', '{:.2f} / {:.2f} / {:.2f}',
            ('consistency.nis_camera', 'consistency.nis_wheels', 'consistency.nis_gnss'),
            '6 / 1 / 3'),
        Row('Posterior after delays up to 1 s, difference', '{:.0g}',
            ('consistency.order_difference',), '0'),
        Row('KITTI 00, GPS away for 60 s, mean error: ekf / without biases', '{:.1f} / {:.1f} m',
            ('real.kitti_00.ekf.outage_mean_m', 'real.kitti_00.without_biases.outage_mean_m')),
        Row("— GTSAM's example, live / smoothed at the end", '{:.0f} / {:.1f} m',
            ('real.kitti_00.gtsam_every_fix.outage_mean_m',
             'real.kitti_00.gtsam_every_fix_smoothed.outage_mean_m')),
        Row('KITTI-360, one street, median error: guesses / DER / fine-tuned there',
            '{:.2f} / {:.2f} / {:.2f} m',
            tuple(f'real.kitti_360.{key}.t_median_m'
                  for key in ('rough', 'der_before', 'der_after'))),
        Row('IMU samples a second', '{:,.0f}', ('imu_hz',), '≥ 10,000'),
        Row('LiDAR image of 700,000 points', '{:.0f} ms', ('lidar_image_ms',), '≤ 60 ms'),
        Row('— share of its pixels filled, before occlusion', '{:.0f} %',
            ('speed_conditions.fill',), '', 100),
        Row('Compact CMRNet with DER, steps a second', '{:.0f}', ('step_hz.compact_cpu',), '≥ 5'),
        Row('Peak memory of such a step', '{:.0f} MB', ('peak_memory_mb.compact_step',)),
        Row('30 draws of MC dropout, beside one pass', '{:.2f} ×', ('mcd_cost_ratio',), '≤ 1.3 ×'),
    )),
}  # fmt: skip
