import json

import numpy as np
import pytest

from benchmarks.peer_candidates import MapClosure, MapClosuresRun, judged, read_run
from lcd_common import se3
from lcd_loop_closure.evaluation.detection_protocols import protocol_1
from lcd_loop_closure.revisits import RevisitConfig

SETTINGS = RevisitConfig(first_scan=20, excluded_scans=10)


def there_and_back(scans=60):
    """A street of a scan a metre, driven back three metres beside."""
    poses = np.tile(np.eye(4), (2 * scans, 1, 1))
    poses[:scans, 0, 3] = np.arange(scans)
    poses[scans:] = [
        se3.from_rotation_translation(se3.rotation_z(np.pi)[:3, :3], [scans - 1 - k, 3.0, 0.0])
        for k in range(scans)
    ]
    return poses


def run_of(poses, closures, stride=5):
    """A run with maps at every `stride`-th scan; `closures` gives (match, inliers) by scan."""
    scan = np.arange(0, len(poses), stride)
    best = [MapClosure(None, 0, None)] * len(scan)
    for number, (match, inliers) in closures.items():
        T = se3.inverse(poses[match]) @ poses[number]
        best[number // stride] = MapClosure(match, inliers, T)
    return MapClosuresRun(scan, np.zeros(len(scan)), tuple(best))


def test_the_scan_where_a_closure_puts_the_query_is_the_candidate():
    poses = there_and_back()
    # Passed at x = 19 on the way back; the map that overlaps most ends 12 m on.
    found = judged(run_of(poses, {100: (31, 40)}), poses, SETTINGS)
    rows = [list(found.query).index(k) for k in range(100, 105)]
    # The scans up to the next map go on by a metre each.
    np.testing.assert_array_equal(found.match[rows], [19, 18, 17, 16, 15])
    np.testing.assert_allclose(found.distance[rows], [-40.0, -39.9, -39.8, -39.7, -39.6])
    assert found.right[rows].all() and found.loop[rows].all()


def test_a_wrong_closure_is_wrong_and_none_is_never_accepted():
    poses = there_and_back()
    wrong = run_of(poses, {100: (31, 40)})
    T = poses[50].copy()  # 50 m along the street from where it was
    best = [MapClosure(0, 9, T) if one.match is not None else one for one in wrong.best]
    found = judged(MapClosuresRun(wrong.scan, wrong.seconds, tuple(best)), poses, SETTINGS)
    accepted = np.isfinite(found.distance)
    assert accepted.sum() == 5 and not found.right.any()
    curve = protocol_1(found)
    assert curve.recall[-1] == 0.0 and curve.precision[-1] == 0.0
    assert found.loop[~accepted].sum() > 30


def test_what_the_peer_wrote_is_read_with_the_most_inliers(tmp_path):
    maps = [
        {'scan': 0, 'seconds': 0.1, 'closures': []},
        {'scan': 70, 'seconds': 0.2, 'closures': [
            {'scan': 3, 'inliers': 5, 'T_match_query': np.eye(4).tolist()},
            {'scan': 9, 'inliers': 11, 'T_match_query': se3.rotation_z(1.0).tolist()},
        ]},
    ]  # fmt: skip
    (tmp_path / 'run.json').write_text(json.dumps(maps))
    run = read_run(tmp_path / 'run.json')
    np.testing.assert_array_equal(run.scan, [0, 70])
    assert run.best[0] == MapClosure(None, 0, None)
    assert (run.best[1].match, run.best[1].inliers) == (9, 11)
    assert se3.yaw(run.best[1].T_match_query) == pytest.approx(1.0)
