"""The two commands as users call them, on embeddings that are made up."""

import json

import numpy as np
import pytest
from made_runs import made_run

from uncertain_place_recognition import calibrate, evaluate
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.runs import SubmapRun
from uncertain_place_recognition.trust import Calibration


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('embedded')
    for name in 'abcdef':
        run = made_run(name, submaps=50, noise=0.3)
        facts = {'weights': {'students': 'a hash'}}
        EmbeddedRun(run.name, run.world, run.stamps_ns, run.positions, run.members, facts).save(
            folder / f'{name}.npz'
        )
    return folder


@pytest.fixture(scope='module')
def calibrated(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp('calibrated') / 'out'
    arguments = [str(folder), '--out', str(out), '--target', '0.1', '--resplits', '3', '--quiet']
    assert calibrate.main(arguments) == 0
    return out


def test_a_calibration_is_written_for_every_target(calibrated):
    loaded = Calibration.load(calibrated / 'calibration.json', 'a hash')
    assert (loaded.acceptance.kind, loaded.acceptance.target) == ('false_match_rate', 0.1)
    assert loaded.acceptance.database_size == 250
    assert loaded.drift is not None
    targets = {
        name: Calibration.load(calibrated / f'calibration_{name}.json').acceptance.target
        for name in ('01', '05')
    }
    assert targets == {'01': 0.01, '05': 0.05}
    figures = json.loads((calibrated / 'results.json').read_text())
    assert len(figures['acceptances']) == len(figures['resplits']) == 12
    assert figures['queries'] == 300 and figures['runs'] == 6
    assert (calibrated / 'calibration.png').stat().st_size > 10_000


@pytest.mark.parametrize(('apart', 'size'), [([], 5 * 50), (['--apart'], 2 * 50)])
def test_worlds_share_the_map_that_a_promise_covers_unless_apart(tmp_path, apart, size):
    for name in 'abcdef':
        run = made_run(name, world='xy'['def'.count(name)], submaps=50, noise=0.3)
        facts = {'weights': {'students': 'a hash'}}
        EmbeddedRun(run.name, run.world, run.stamps_ns, run.positions, run.members, facts).save(
            tmp_path / 'runs' / f'{name}.npz'
        )
    out = tmp_path / 'out'
    assert calibrate.main([str(tmp_path / 'runs'), '--out', str(out), '--quiet', *apart]) == 0
    assert Calibration.load(out / 'calibration.json').acceptance.database_size == size


def test_the_names_of_files_tell_the_target():
    assert [calibrate._percent(t) for t in (0.01, 0.05, 0.1, 0.001)] == ['01', '05', '10', '001']


def test_an_evaluation_writes_figures_and_pictures(folder, calibrated, tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = [str(folder / f'{name}.npz') for name in 'abc']
    arguments += ['--calibration', str(calibrated / 'calibration.json'), '--out', str(out)]
    assert evaluate.main([*arguments, '--no-match', '0.3', '--open-set', '--quiet']) == 0
    figures = json.loads((out / 'results.json').read_text())
    assert figures['pairs'] == 6
    assert set(figures['recall']) == {
        'teacher', 'student', 'shared', 'naive', 'mason', 'dropout', 'stun',
    }  # fmt: skip
    failure = figures['failure']['shared_combined']
    # Of 300 queries three tenths have no place, and these matches are wrong.
    assert failure['queries'] == 300 and failure['base_rate'] > 0.25
    assert failure['auroc_low'] <= failure['auroc'] <= failure['auroc_high']
    assert figures['failure']['distance']['auroc'] > 0.7
    assert figures['interchange']['naive']['off_diagonal_r1'] < 0.3
    for name in ('removal', 'risk_coverage', 'reliability', 'interchange'):
        assert (out / f'{name}.png').stat().st_size > 10_000
    shown = capsys.readouterr().out
    assert 'mason_variance' in shown and 'R@1 95 %' in shown and 'ECE' in shown


@pytest.mark.parametrize('command', [evaluate, calibrate])
def test_help_has_examples(command, capsys):
    with pytest.raises(SystemExit):
        command.main(['--help'])
    assert 'examples:' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['missing.npz'], 'missing.npz'),
        (['{folder}/a.npz'], 'no two runs are of one world'),
        (['{folder}', '--ensemble', 'teachers=x'], "role 'teachers' is unknown"),
        (['{folder}', '--ensemble', 'students=none'], 'none does not exist'),
        (['{empty}'], 'no runs'),
        (['{folder}', '--calibration', '{wrong}'], 'calibrates other weights'),
        (['{submaps}'], 'holds submaps; name the ensemble'),
    ],
)
def test_mistakes_are_one_line(folder, calibrated, tmp_path, capsys, arguments, said):
    (tmp_path / 'empty').mkdir()
    wrong = tmp_path / 'calibration.json'
    wrong.write_text((calibrated / 'calibration.json').read_text().replace('a hash', 'another'))
    poses = np.tile(np.eye(4), (3, 1, 1))
    submaps = tmp_path / 'submaps.npz'
    points = np.zeros((3, 8, 3), np.float16)
    SubmapRun('s', 'w', np.arange(3), poses, points).save(submaps)
    places = {'folder': folder, 'empty': tmp_path / 'empty', 'wrong': wrong, 'submaps': submaps}
    given = [text.format(**places) for text in arguments]
    assert evaluate.main([*given, '--out', str(tmp_path / 'out'), '--quiet']) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]


def test_a_folder_of_other_things_is_left_alone(folder, tmp_path, capsys):
    (tmp_path / 'thesis.txt').write_text('years of work')
    assert calibrate.main([str(folder), '--out', str(tmp_path), '--quiet']) == 1
    assert 'holds other things' in capsys.readouterr().err


def test_runs_of_unknown_weights_are_not_calibrated(tmp_path, capsys):
    for name in 'ab':
        made_run(name).save(tmp_path / 'runs' / f'{name}.npz')
    assert calibrate.main([str(tmp_path / 'runs'), '--out', str(tmp_path / 'out'), '--quiet']) == 1
    assert 'embed their submaps again' in capsys.readouterr().err
