"""The command from a folder of sweeps to tables, page and pictures."""

import json

import numpy as np
import pytest
from evaluation_samples import World, out_and_back, tiny_weights

from bags.drives import open_drive
from lcd_common import se3
from lcd_loop_closure.evaluation.detection import judge_descriptor
from lcd_loop_closure.evaluation.drive_sweeps import spaced, store_drive
from lcd_loop_closure.evaluation.evaluate_loops import main
from lcd_loop_closure.report.reference import read_reference
from lcd_loop_closure.revisits import RevisitConfig
from lcd_loop_closure.scan_context import ScanContext

T_BASE_LIDAR = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 1.73])
FEW = ['--first', '5', '--excluded', '8', '--quiet']


@pytest.fixture(scope='module')
def sequence(tmp_path_factory):
    """Return a KITTI sequence: a street there and back."""
    root = tmp_path_factory.mktemp('kitti')
    world = World(out_and_back(60.0))
    folder = root / 'sequences' / '00'
    (folder / 'velodyne').mkdir(parents=True)
    (root / 'poses').mkdir()
    for k in range(len(world.T_world_base)):
        cloud = world.cloud(k).transformed(se3.inverse(T_BASE_LIDAR))
        points = np.column_stack([cloud.xyz, cloud.intensity]).astype(np.float32)
        points.tofile(folder / 'velodyne' / f'{k:06d}.bin')
    poses = world.T_world_base @ T_BASE_LIDAR
    np.savetxt(root / 'poses' / '00.txt', poses[:, :3].reshape(-1, 12))
    np.savetxt(folder / 'times.txt', 0.1 * np.arange(len(poses)))
    identity = ' '.join(str(v) for v in np.eye(4)[:3].ravel())
    (folder / 'calib.txt').write_text(
        ''.join(f'{n}: {identity}\n' for n in ('P0', 'P1', 'P2', 'P3', 'Tr'))
    )
    return folder


@pytest.fixture(scope='module')
def weights(tmp_path_factory):
    return tiny_weights(tmp_path_factory.mktemp('weights'))


def test_a_folder_gives_tables_page_and_pictures(sequence, weights, tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = [
        str(sequence), '--out', str(out), '--weights', str(weights), *FEW,
        '--methods', 'lcdnet', 'scan_context', '--rear-block', '70',
        '--registration', 'lcdnet_fast', 'lcdnet_ransac', 'scan_context_yaw',
        '--bands', '0-4', '4-10', '--pairs', '4',
    ]  # fmt: skip
    assert main(arguments) == 0
    figures = json.loads((out / 'results.json').read_text())
    assert figures['drive']['scans'] == 40 and figures['drive']['reverse_share'] == 1.0
    assert set(figures['detection']) == {'whole', 'rear_70', 'rear_70_aggregated'}
    whole = figures['detection']['whole']
    assert whole['scan_context']['protocol_1']['same_way'] is None
    # Table 3.1 also counts partners exactly `excluded` scans before, the protocols do not.
    loops = whole['scan_context']['protocol_1']['reverse']['loops']
    assert loops == figures['drive']['loops'] - 1 == 16
    # The same by hand, from what the reader gives.
    drive = open_drive(sequence)
    sweeps = store_drive(drive, tmp_path / 'store')
    descriptor = ScanContext()
    rows = np.array(
        [descriptor.row(descriptor.describe(sweeps.cloud(k))) for k in range(len(sweeps))]
    )
    expected = judge_descriptor(
        lambda i, m: descriptor.compare(rows[i], rows[:m])[0],
        sweeps.T_world_base,
        RevisitConfig(first_scan=5, excluded_scans=8),
    )
    for name, curves in (
        ('protocol_1', expected.protocol_1),
        ('protocol_2', expected.protocol_2),
    ):
        found = whole['scan_context'][name]['all']['average_precision']
        assert found == pytest.approx(curves['all'].average_precision)
    assert figures['registration']['4_10']['methods']['lcdnet_ransac']['pairs'] == 4
    assert 'te_m' not in figures['registration']['0_4']['methods']['scan_context_yaw']
    assert '0_4_rear_70' in figures['registration']
    page = (out / 'report.html').read_text()
    pictures = sorted(path.name for path in (out / 'plots').iterdir())
    assert 'precision_recall_whole.png' in pictures and 'detections_rear_70.png' in pictures
    assert page.count('<img') == len(pictures)
    assert not (out / 'cache').exists()
    shown = capsys.readouterr().out
    assert 'Loop detection: whole sweeps' in shown and 'report' in shown


def test_what_was_kept_is_used_again(sequence, weights, tmp_path, monkeypatch):
    arguments = [
        str(sequence), *FEW, '--methods', 'scan_context', '--cache', str(tmp_path / 'cache'),
    ]  # fmt: skip
    assert main([*arguments, '--out', str(tmp_path / 'a')]) == 0
    monkeypatch.setattr(ScanContext, 'describe', lambda *_: pytest.fail('described again'))
    assert main([*arguments, '--out', str(tmp_path / 'b')]) == 0
    first, second = (json.loads((tmp_path / n / 'results.json').read_text()) for n in 'ab')
    assert first == second


def test_poses_from_a_file_and_their_frame(sequence, tmp_path):
    drive = open_drive(sequence)
    poses = sequence.parent.parent / 'poses' / '00.txt'
    own = store_drive(drive, tmp_path / 'own')
    given = store_drive(
        drive, tmp_path / 'given', reference=read_reference(poses), T_base_body=T_BASE_LIDAR
    )
    assert len(given) == len(own)
    apart = se3.inverse(own.T_world_base[0]) @ own.T_world_base[30]
    assert np.allclose(se3.inverse(given.T_world_base[0]) @ given.T_world_base[30], apart)
    few = store_drive(
        drive, tmp_path / 'few', reference=read_reference(poses), T_base_body=T_BASE_LIDAR,
        spacing_m=6.0,
    )  # fmt: skip
    steps = np.linalg.norm(np.diff(few.T_world_base[:, :3, 3], axis=0), axis=1)
    assert steps.min() >= 5.7 and len(few) == pytest.approx(len(own) / 2, abs=2)


def test_spacing_keeps_poses_a_distance_apart():
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = [0, 0.1, 0.2, 1.0, 1.1, 1.9, 2.0, 2.95, 2.96, 9]
    assert list(spaced(poses, 1.0)) == [0, 3, 6, 7, 9]
    assert list(spaced(poses, 0.0)) == list(range(10))
    assert len(spaced(poses[:0], 1.0)) == 0


@pytest.mark.parametrize(
    ('more', 'message'),
    [
        (['--weights', 'nowhere.safetensors'], 'nowhere.safetensors: expected the weights'),
        (['--methods', 'scan_context', '--bands', '4:10'], 'LOW-HIGH in metres'),
        (['--methods', 'scan_context', '--bands', '9-4'], 'LOW-HIGH in metres'),
        (['--methods', 'scan_context', '--truth', 'gone.txt'], 'gone.txt'),
    ],
)
def test_mistakes_are_one_line_and_early(sequence, tmp_path, capsys, more, message):
    assert main([str(sequence), '--out', str(tmp_path / 'out'), *FEW, *more]) == 1
    error = capsys.readouterr().err
    assert error.startswith('error: ') and error.count('\n') == 1 and message in error


def test_a_folder_of_other_things_is_left_alone(sequence, tmp_path, capsys):
    (tmp_path / 'thesis.tex').write_text('years of work')
    assert main([str(sequence), '--out', str(tmp_path), '--methods', 'scan_context']) == 1
    assert 'holds other things' in capsys.readouterr().err
    assert main([str(tmp_path / 'thesis.tex'), '--out', str(tmp_path / 'thesis.tex')]) == 1


def test_a_drive_without_truth_says_so(sequence, tmp_path, capsys):
    lonely = tmp_path / '00'
    lonely.symlink_to(sequence)
    copy = tmp_path / 'alone' / '01'
    (copy / 'velodyne').mkdir(parents=True)
    for path in list((sequence / 'velodyne').iterdir())[:3]:
        (copy / 'velodyne' / path.name).write_bytes(path.read_bytes())
    for name in ('times.txt', 'calib.txt'):
        (copy / name).write_text((sequence / name).read_text())
    assert main([str(copy), '--out', str(tmp_path / 'o'), '--methods', 'scan_context']) == 1
    assert 'no ground truth' in capsys.readouterr().err


def test_help_shows_examples_and_methods(capsys):
    with pytest.raises(SystemExit):
        main(['--help'])
    shown = capsys.readouterr().out
    assert 'evaluate_loops town:200' in shown and 'kiss_matcher' in shown
