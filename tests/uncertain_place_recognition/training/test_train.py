"""The command: roles, what they write, and one line for a mistake."""

import json
import subprocess
import sys

import numpy as np
import pytest
from small_runs import small_run

from uncertain_place_recognition.ensemble import EmbeddingEnsemble
from uncertain_place_recognition.training.train import main

_SMALL = [
    '--network', 'bev_netvlad', '--set', 'rows=8', 'columns=16', 'widths=6,8', 'blocks=1,1',
    'clusters=4', 'size=8',
]  # fmt: skip
_SHORT = ['--train', 'steps=6', 'clouds=12', '--pairs', 'positive=11', 'negative=35', '--quiet',
          '--validate-every', '6']  # fmt: skip


@pytest.fixture(scope='module')
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp('runs')
    for name, world in (('a', 'w'), ('b', 'w'), ('c', 'v')):
        small_run(name, world, spacing_m=10.0).save(folder / 'train' / f'{name}.npz')
    for name in 'de':
        small_run(name, 'u', spacing_m=10.0).save(folder / 'validation' / f'{name}.npz')
    return [
        '--runs', str(folder / 'train'), '--validation', str(folder / 'validation')
    ]  # fmt: skip


def test_an_ensemble_is_trained_packed_and_goes_on(runs, tmp_path, capsys):
    command = ['ensemble', *runs, *_SMALL, *_SHORT, '--members', '2', '--out', str(tmp_path)]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert 'off-diagonal' in told and 'diversity' in told and '2 members' in told
    ensemble = EmbeddingEnsemble.load(tmp_path)
    assert (ensemble.size, ensemble.length) == (2, 8)
    found = ensemble.embed(small_run().points[0].astype(np.float32))
    assert np.abs(found[0] - found[1]).max() > 0.0
    card = json.loads((tmp_path / 'ensemble.json').read_text())
    assert np.array(card['interchange']['recall_1']).shape == (2, 2)
    assert [one['role'] for one in card['members_trained']] == ['student', 'student']
    assert card['members_trained'][0]['trained_on'] == ['a', 'b', 'c']
    student = json.loads((tmp_path / 'student_1' / 'best.json').read_text())
    assert student['training']['steps'] == 3  # half the teacher's
    assert student['training']['seed'] == 1
    assert student['validation']['teacher_recall_1'] is not None
    assert (tmp_path / 'teacher' / 'curves.png').stat().st_size > 1000
    assert main(command) == 0
    assert capsys.readouterr().out.count('trained already') == 3


def test_time_runs_out_and_the_same_command_goes_on(runs, tmp_path, capsys):
    command = ['ensemble', *runs, *_SMALL, *_SHORT, '--members', '1', '--out', str(tmp_path)]
    assert main([*command, '--minutes', '0']) == 0
    told = capsys.readouterr().out
    assert 'no time for a step' in told and 'no student begins' in told
    assert not (tmp_path / 'student_1').exists()
    assert main(command) == 0
    assert '1 members' in capsys.readouterr().out


def test_the_other_roles(runs, tmp_path):
    common = [*runs, *_SHORT]
    teacher = tmp_path / 'teacher'
    assert main(['teacher', *common, *_SMALL, '--out', str(teacher)]) == 0
    assert main(['dropout', *common, *_SMALL, '--rate', '0.3', '--out', str(tmp_path / 'd')]) == 0
    assert main(['stun', *common, '--teacher', str(teacher), '--out', str(tmp_path / 's')]) == 0
    dropout, stun = EmbeddingEnsemble.load(tmp_path / 'd'), EmbeddingEnsemble.load(tmp_path / 's')
    assert (dropout.size, dropout.settings.dropout) == (5, 0.3)
    assert stun.embed_with_variance(small_run().points[0].astype(np.float32))[1] is not None
    packed = tmp_path / 'naive'
    assert main(['pack', str(teacher), str(tmp_path / 'teacher' / 'best.safetensors'),
                 '--out', str(packed), '--quiet']) == 0  # fmt: skip
    assert EmbeddingEnsemble.load(packed).size == 2
    several = ['--teacher', str(packed / 'ensemble.safetensors')]
    assert main(['student', *common, *several, '--seed', '2', '--out', str(tmp_path / 'm')]) == 0
    assert EmbeddingEnsemble.load(tmp_path / 'm').size == 1
    assert main(['stun', *common, *several, '--out', str(tmp_path / 'n')]) == 1


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (['--train', 'stepz=3'], "'stepz=3' is no setting"),
        (['--train', 'steps=many'], 'expected a value of type int'),
        (['--set', 'view=sideways'], 'must be one of cartesian, polar'),
        (['--preset', 'huge'], 'it has original, compact'),
        (['--pairs', 'positive=60'], 'farther away than positives'),
        (['--runs', 'nowhere'], 'nowhere'),
        (['--device', 'abacus'], 'abacus'),
    ],
)
def test_mistakes_are_one_line(runs, tmp_path, capsys, change, message):
    command = ['teacher', *runs, '--network', 'bev_netvlad', '--out', str(tmp_path), '--quiet']
    assert main([*command, *change]) == 1
    error = capsys.readouterr().err
    assert error.startswith('error: ') and error.count('\n') == 1 and message in error


def test_towns_are_kept_apart(runs, tmp_path, capsys):
    same = ['--runs', runs[1], '--validation', runs[1]]
    assert main(['teacher', *same, '--out', str(tmp_path), '--quiet']) == 1
    assert 'keep towns apart' in capsys.readouterr().err


def test_training_needs_neither_ros_nor_open3d():
    check = (
        'import sys, uncertain_place_recognition.training.train as t; t.parser;'
        "print([m for m in ('rclpy', 'open3d', 'gtsam', 'lcd_msgs') if m in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, '-c', check], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == '[]'
