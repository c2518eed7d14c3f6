"""Run the command as a user does, on tiny networks trained for a few steps."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_samples import SMALL, street_samples

from cmrnet_ekf.camera_localizer import imager_of
from cmrnet_ekf.evaluation import evaluate
from cmrnet_ekf.evaluation.named_networks import named_predictors
from cmrnet_ekf.evaluation.refinement import refine
from cmrnet_ekf.mapping.local_map import LocalMap, near_origin
from cmrnet_ekf.networks.checkpoint import save_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.losses import LossConfig
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.trainer import Trainer, TrainingConfig
from lcd_common import se3
from lcd_common.errors import ConfigError

ROLES = {'plain0': {}, 'plain1': {}, 'mcd': {'dropout': 0.3}, 'der': {'head': 'evidential'}}


@pytest.fixture(scope='module')
def judged(tmp_path_factory) -> Path:
    return street_samples(tmp_path_factory.mktemp('judged'), draws=2, spacing=1.0).path


@pytest.fixture(scope='module')
def weights(tmp_path_factory, judged) -> Path:
    """Folders as train_cmrnet leaves them: the best network, and what it goes on from."""
    folder = tmp_path_factory.mktemp('weights')
    for number, (role, changes) in enumerate(ROLES.items()):
        torch.manual_seed(number)
        network = Cmrnet(replace(SMALL, **changes))
        settings = TrainingConfig(steps=25, batch=4, learning_rate=3e-3)
        trainer = Trainer(network, [SampleSet(judged)], folder / role, settings, LossConfig())
        list(trainer.run())
        save_network(folder / role / 'best.safetensors', network, {})
    return folder


def arguments(judged, weights, out, *more):
    return [
        str(judged), '--out', str(out), '--quiet', '--networks', f'cmrnet={weights}/plain0',
        f'mcd={weights}/mcd', f'de={weights}/plain0,{weights}/plain1', f'der={weights}/der', *more,
    ]  # fmt: skip


def test_the_command_writes_what_can_be_recomputed(tmp_path, judged, weights, capsys):
    out = tmp_path / 'results'
    assert evaluate.main(arguments(judged, weights, out)) == 0
    figures = json.loads((out / 'results.json').read_text())
    raw = np.load(out / 'predictions.npz')
    samples = SampleSet(judged)
    assert figures['samples'] == len(samples) == 20 and figures['drives'] == ['made_up_street']
    assert figures['kinds'] == {'cmrnet': 'plain', 'mcd': 'mcd', 'de': 'de', 'der': 'der'}
    for name in ('cmrnet', 'mcd', 'de', 'der'):
        metres = np.linalg.norm((raw['target'] - raw[f'{name}_mean'])[:, :3], axis=1)
        assert figures['localization'][name]['t_mean_m'] == pytest.approx(metres.mean())
        assert figures['localization'][name]['t_median_m'] == pytest.approx(np.median(metres))
    rough = np.linalg.norm(np.asarray(samples.guesses)[:, :3, 3], axis=1)
    assert figures['localization']['rough']['t_median_m'] == pytest.approx(np.median(rough))
    assert figures['localization']['rough']['failures_1m'] == pytest.approx((rough > 1).mean())
    # Only evidence is judged as Student-t.
    assert np.isinf(raw['de_freedom']).all() and np.isfinite(raw['der_freedom']).all()
    assert set(figures['calibration']) == {'mcd', 'de', 'der'} == set(figures['rejection'])
    # The mean of both members, and half their distance.
    one, other = (
        Predictor.load(weights / role).belief(*pair(samples)).mean for role in ('plain0', 'plain1')
    )
    np.testing.assert_allclose(raw['de_mean'], (one + other) / 2, atol=1e-5)
    np.testing.assert_allclose(raw['de_scale'], np.abs(one - other) / 2, atol=1e-5)
    assert list(figures['by_count']) == ['mcd', 'de']
    # Thirty draws of the hundred are what the table shows.
    assert figures['by_count']['mcd']['30']['t_mean_m'] == pytest.approx(
        figures['localization']['mcd']['t_mean_m']
    )
    assert set(figures['by_count']['mcd']) >= {'2', '30', '100'}
    assert figures['stretch']['frames'] == 10
    report = (out / 'results.md').read_text()
    for name in ('errors', 'calibration', 'rejection', 'counts', 'stretch'):
        assert (out / f'{name}.png').stat().st_size > 5000 and f'{name}.png' in report
    assert f'{figures["localization"]["der"]["t_median_m"]:.3f}' in report
    assert 'der' in capsys.readouterr().out


def pair(samples):
    batch = samples.batch(np.arange(len(samples)))
    return batch.image, batch.lidar


def test_a_later_stage_looks_from_where_the_first_one_said(judged, weights):
    samples = SampleSet(judged)
    first, second = (Predictor.load(weights / role) for role in ('plain0', 'plain1'))
    seen = []
    second.belief = lambda image, lidar, ask=second.belief: seen.append(lidar) or ask(image, lidar)
    found = refine([first, second], [samples])
    row = 7
    T_map_camera = samples.T_map_camera[samples.frame_of[row]]
    correction = first.belief(*(part[row : row + 1] for part in pair(samples))).transforms[0]
    T_map_second = T_map_camera @ samples.guesses[row] @ correction
    points, origin = LocalMap(Path(samples.facts['map'])).around(T_map_second)
    expected = imager_of(samples.camera, SMALL).image(
        points, T_OPTICAL_BODY @ se3.inverse(near_origin(T_map_second, origin))
    )
    lidar = torch.cat(seen)
    assert lidar.shape == (20, 32, 64)
    assert ((lidar[row] - expected).abs() > 1e-3).float().mean() < 0.01, 'but for borders of pixels'
    # What is left after the second stage is the true camera seen from where that one put it.
    T_map_found = T_map_second @ found[1].belief.transforms[row]
    left = np.linalg.norm(T_map_found[:3, 3] - T_map_camera[:3, 3])
    assert found[1].errors[0][row] == pytest.approx(left, abs=1e-6)
    assert found[0].errors[0][row] == pytest.approx(
        np.linalg.norm((T_map_second - T_map_camera)[:3, 3]), abs=1e-6
    )


def test_three_stages_stand_apart(tmp_path, judged, weights):
    stages = ['--second', f'cmrnet={weights}/plain1', '--third', f'cmrnet={weights}/plain0']
    more = [*stages, '--per-set', '6', '--no-counts']
    assert evaluate.main(arguments(judged, weights, tmp_path / 'out', *more)) == 0
    figures = json.loads((tmp_path / 'out' / 'results.json').read_text())
    assert list(figures['refined']['cmrnet']) == [f'after_stage_{k}' for k in (1, 2, 3)]
    assert figures['refined']['cmrnet']['after_stage_1'] == figures['localization']['cmrnet']
    assert figures['samples'] == 6 and set(figures['by_count']['mcd']) == {
        '2', '3', '5', '10', '20', '30',
    }  # fmt: skip
    assert 'after stage 3' in (tmp_path / 'out' / 'results.md').read_text()


@pytest.mark.parametrize(
    ('more', 'message'),
    [
        (['--networks', 'der'], 'NAME=FILE'),
        (['--networks', 'rough={w}/der'], 'row of the guesses'),
        (['--networks', 'a={w}/der', 'a={w}/der'], 'comes twice'),
        (['--networks', 'a={w}/plain0,{w}/plain0'], 'comes twice'),
        (['--networks', 'a={w}/plain0,{w}/der'], 'quaternion heads'),
        (['--networks', 'a={w}/nothing'], 'expected a .safetensors'),
        (['--third', 'cmrnet={w}/plain0'], 'give both'),
        (['--second', 'other={w}/plain0'], 'the stage before has not'),
        (['--device', 'abacus'], 'auto, cpu or cuda'),
    ],
)
def test_mistakes_are_one_line(tmp_path, judged, weights, capsys, more, message):
    more = [text.format(w=weights) for text in more]
    assert evaluate.main(arguments(judged, weights, tmp_path / 'out', *more)) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_a_folder_with_other_things_is_left_alone(tmp_path, judged, weights, capsys):
    (tmp_path / 'thesis.tex').touch()
    assert evaluate.main(arguments(judged, weights, tmp_path)) == 1
    assert 'other things' in capsys.readouterr().err


def test_samples_of_other_images_are_refused(tmp_path, judged, capsys):
    save_network(tmp_path / 'other.safetensors', Cmrnet(replace(SMALL, focal=50.0)), {})
    command = [str(judged), '--networks', f'a={tmp_path}/other.safetensors', '--quiet']
    assert evaluate.main([*command, '--out', str(tmp_path / 'out')]) == 1
    assert 'make samples for this network' in capsys.readouterr().err


def test_a_folder_of_trainings_is_an_ensemble(weights, tmp_path):
    for role in ('plain0', 'plain1'):
        (tmp_path / role).symlink_to(weights / role)
    found = named_predictors([f'de={tmp_path}', f'one={weights}/plain0'])
    assert [p.kind for p in found.values()] == ['de', 'plain']
    with pytest.raises(ConfigError, match='draws nothing'):
        found['one'].draws(torch.zeros(1, 3, 32, 64), torch.zeros(1, 32, 64))
