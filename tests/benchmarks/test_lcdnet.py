"""How the sections of benchmarks.lcdnet are put together, on results that are made up."""

import numpy as np
import pytest

from benchmarks import lcdnet, lcdnet_drives, report
from lcd_common import se3
from lcd_loop_closure.evaluation.detection import judge_descriptor
from lcd_loop_closure.evaluation.study import JudgedMethod
from lcd_loop_closure.revisits import RevisitConfig


@pytest.fixture(scope='module')
def judged():
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = np.concatenate([np.arange(30), np.arange(30)[::-1]]) * 2.0
    poses[30:] = poses[30:] @ se3.rotation_z(np.pi)
    rng = np.random.default_rng(0)
    rows = poses[:, :3, 3] + rng.normal(0, 1.0, (60, 3))
    detection = judge_descriptor(
        lambda i, m: np.linalg.norm(rows[:m] - rows[i], axis=1),
        poses,
        RevisitConfig(first_scan=10, excluded_scans=5),
    )
    return JudgedMethod(detection, 3.0)


def test_average_precision_is_the_mean_over_towns_of_its_class(judged):
    found = {'reverse': {'town_1': {'m2dp': judged}, 'town_2': {'m2dp': judged, 'isc': 'no light'}}}
    figures = lcdnet_drives._average_precision(found)
    expected = judged.detection.protocol_2['reverse'].average_precision
    assert figures['protocol2']['reverse'] == {'m2dp': pytest.approx(expected)}
    assert figures['missing'] == {'isc': 'no light'}
    assert 0.0 < expected < 1.0


def test_required_figures_are_found_where_sections_put_them(judged):
    assert 'ap.protocol2.reverse.map_closures' not in lcdnet.REQUIRED
    methods = dict.fromkeys(('lcdnet', 'scan_context', 'm2dp', 'isc', 'lidar_iris'), judged)
    found = {kind: {'town_200': methods} for kind in ('same_way', 'reverse')}
    ap = lcdnet_drives._average_precision(found)
    figures = lcdnet._placed({'query_ms': {'18235': 1.0}}, 'detection', {'ap': ap})
    absent = report.missing(figures, lcdnet.REQUIRED)
    assert not [key for key in absent if key.startswith('ap.') and 'map_closures' not in key]
    assert 'registration.10_15.te_m.lcdnet_ransac' in absent
    assert 'query_ms.18235' not in absent and 'query_ms.1000000' in absent


def test_a_later_run_of_a_section_keeps_what_others_wrote():
    first = lcdnet._placed({}, 'detection', {'ap': {'protocol1': {'reverse': {'m2dp': 0.5}}}})
    second = lcdnet._placed(first, 'detection', {'ap': {'protocol1': {'reverse': {'isc': 0.4}}}})
    assert second['ap']['protocol1']['reverse'] == {'m2dp': 0.5, 'isc': 0.4}
    third = lcdnet._placed(second, 'speed', {'keyframe_bytes': 7})
    assert third['keyframe_bytes'] == 7 and third['ap'] == second['ap']


def test_map_closures_is_judged_by_class_beside_the_others(judged, monkeypatch, tmp_path):
    asked = []

    def curve(work, sweeps, reverse, kind):
        asked.append((sweeps, kind, int(reverse.sum())))
        return judged.detection.protocol_1[kind]

    monkeypatch.setattr(lcdnet_drives, 'rendered', lambda work, kind, seed, length_m: seed)
    monkeypatch.setattr(lcdnet_drives, 'judge_map_closures', curve)
    monkeypatch.setattr(
        lcdnet_drives,
        'study_detection',
        lambda *_, **__: {'whole': {'lcdnet': judged, 'scan_context': judged}},
    )
    figures = lcdnet_drives.map_closures(tmp_path)
    reverse = int(judged.detection.reverse.sum())
    assert asked == [(200, 'same_way', reverse), (200, 'reverse', reverse)] and reverse > 0
    before = {'ap': {'protocol1': {'reverse': {'m2dp': 0.5}}}}
    placed = lcdnet._placed(before, 'map_closures', figures)
    expected = judged.detection.protocol_1['reverse'].average_precision
    assert placed['ap']['protocol1']['reverse'] == {'m2dp': 0.5, 'map_closures': expected}
    beside = placed['map_closures_drives']['reverse']
    assert beside == dict.fromkeys(('map_closures', 'lcdnet', 'scan_context'), expected)


def test_every_section_is_listed(capsys):
    assert lcdnet.main(['--list']) == 0
    shown = capsys.readouterr().out
    for name in ('detection', 'sectors', 'registration', 'real', 'speed'):
        assert name in shown
