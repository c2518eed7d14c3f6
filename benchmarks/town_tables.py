"""What the tables about the simulator show of benchmarks/results/town.json."""

from benchmarks.result_table import Cell, Row, Table, WideRow

_RECORDINGS = {'kitti_00': 'KITTI 00', 'kitti_360': 'KITTI-360', 'karlsruhe': 'Karlsruhe'}


def _both(what: str, statistic: str, shown: str, times: float = 1.0) -> WideRow:
    """Return a row of a statistic that a set of sweeps has by itself."""
    cells = (
        Cell(shown, tuple(f'real_vs_sim.{name}.{statistic}.{of}' for of in ('real', 'simulated')),
             times)
        for name in _RECORDINGS
    )  # fmt: skip
    return WideRow(what, (*cells, ''))


def _distance(what: str, statistic: str, lacking: tuple[str, ...] = ()) -> WideRow:
    """Return a row of a distance between two sets; some recordings lack what it is about."""
    cells = (
        'has none' if name in lacking else Cell('{:.2f}', (f'real_vs_sim.{name}.{statistic}',))
        for name in (*_RECORDINGS, 'real_against_real')
    )
    return WideRow(what, tuple(cells))


def _difficulty(what: str, name: str) -> WideRow:
    """Return a row of a test set: means over its towns."""
    below = f'scan_context_ap.{name}_by_town.*'
    distances = ('within_a_place', 'to_most_similar_other_place', 'between_places')
    return WideRow(
        what,
        (
            Cell('{:.3f}', (f'scan_context_ap.{name}',)),
            *(Cell('{:.2f}', (f'{below}.distance_{distance}',)) for distance in distances),
            Cell('{:.0f} %', (f'{below}.aliased_share',), 100),
        ),
    )


TOWN_TABLES = {
    'town': Table('town', (
        Row('HDL-64E sweeps a second, two cores', '{:.1f}', ('sweeps_per_second_cpu',), '≥ 12'),
        Row('— on a GPU, by the torch renderer', '{:.0f}', ('sweeps_per_second_gpu',), '≥ 300'),
        Row('Camera frames of 1241 x 376 a second, two cores', '{:.1f}',
            ('camera_frames_per_second_cpu',), '≥ 8'),
        Row('Rays on which both renderers agree within 1 cm', '{:.3f} %',
            ('renderers_within_1cm_share',), '≥ 99.9 %', 100),
        Row('Drift of KISS-ICP', '{:.2f} %', ('kiss_icp_drift_percent',), '0.3-0.8 %'),
        Row('A simulated drive, ours / KISS-SLAM: ATE of odometry', '{:.2f} / {:.2f} m',
            ('kiss_slam.suite.odometry_ate_m', 'kiss_slam.kiss_slam.odometry_ate_m')),
        Row('— ATE with loops', '{:.2f} / {:.2f} m',
            ('kiss_slam.suite.ate_m', 'kiss_slam.kiss_slam.ate_m')),
        Row('— loops right and wrong', '{:.0f} and {:.0f} / {:.0f} and {:.0f}',
            tuple(f'kiss_slam.{of}.loops_{kind}'
                  for of in ('suite', 'kiss_slam') for kind in ('right', 'wrong'))),
        Row('— time of a scan', '{:.0f} / {:.0f} ms',
            ('kiss_slam.suite.ms_per_scan', 'kiss_slam.kiss_slam.ms_per_scan')),
        Row('Average precision of Scan Context, same way', '{:.2f}',
            ('scan_context_ap.same_way',), '0.90-0.98'),
        Row('— in reverse', '{:.2f}', ('scan_context_ap.reverse',), '0.50-0.80'),
        Row('Live at 10 Hz: scans that odometry lost', '{:.0f}', ('live_10hz.odometry_lost',), '0'),
        Row('— odometry latency, 99 %', '{:.0f} ms',
            ('live_10hz.odometry_latency_p99_ms',), '≤ 150 ms'),
    )),
    'realism': Table('town', (
        _both('Points of a sweep', 'points', '{:,.0f} / {:,.0f}'),
        _both('Points of a ring, mean', 'ring_mean', '{:,.0f} / {:,.0f}'),
        _both('— standard deviation over the rings of a sweep', 'ring_std', '{:.0f} / {:.0f}'),
        _both('Points on the ground', 'ground_share', '{:.0f} / {:.0f} %', 100),
        _both('Planarity of neighbourhoods, median', 'planarity', '{:.2f} / {:.2f}'),
        _both('Linearity of neighbourhoods, median', 'linearity', '{:.2f} / {:.2f}'),
        _distance('Histograms of range, distance', 'range_histogram_distance'),
        _distance('Histograms of intensity, distance', 'intensity_histogram_distance',
                  ('karlsruhe',)),
    ), header=('real / simulated', *_RECORDINGS.values(), 'KITTI 00 / KITTI-360, both real'),
        section='realism'),
    'difficulty': Table('town', (
        _difficulty('Same way', 'same_way'),
        _difficulty('In reverse', 'reverse'),
        _difficulty('Same way, aliased district', 'aliased_same_way'),
        _difficulty('Same way, OS1-64', 'second_sensor_same_way'),
        _difficulty('In reverse, OS1-64', 'second_sensor_reverse'),
    ), header=('drives', 'average precision', 'distance within a place',
               'to the most similar other place', 'between places',
               'another place is more alike'),
        section='scan_context'),
}  # fmt: skip
