"""Run the commands as a user does."""

import json
from pathlib import Path

import numpy as np
import pytest
from small_samples import SMALL, street_samples

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training import make, train, variants
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.validation import predictions, validate
from cmrnet_ekf.training.variants import VARIANTS, variant


@pytest.fixture(scope='module')
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp('sets')
    names = []
    for name in ('learnt', 'judged'):
        path = street_samples(folder / name).path
        facts = json.loads((path / 'facts.json').read_text())
        (path / 'facts.json').write_text(json.dumps({**facts, 'drive': name}))
        names.append(str(path))
    return names


@pytest.fixture(autouse=True)
def small(monkeypatch):
    training = variants.NETWORKS['compact'][1]
    monkeypatch.setitem(variants.NETWORKS, 'compact', (SMALL, training))


def test_a_variant_is_trained_goes_on_and_comes_back(tmp_path, sets):
    samples = ['--samples', sets[0], '--validation', sets[1]]
    command = [*samples, '--out', str(tmp_path), '--variant', 'der', '--quiet']
    command += ['--train', 'steps=4', 'batch=4']
    assert train.main([*command, '--minutes', '0']) == 0
    assert train.main(command) == 0
    predictor = Predictor.load(tmp_path / 'best.safetensors')
    assert predictor.kind == 'der'
    card = json.loads((tmp_path / 'best.json').read_text())
    assert card['trained_on'] == ['learnt'] and card['chosen_on'] == ['judged']
    assert len(card['sha256']) == 64
    steps = [json.loads(row)['step'] for row in (tmp_path / 'validation.jsonl').open()]
    assert steps == [0, 4]
    assert (tmp_path / 'curves.png').stat().st_size > 1000
    result = validate(predictor, [SampleSet(Path(sets[1]))])
    assert result.rough.count == result.errors.count == 15
    assert set(result.calibration) == {'x', 'y', 'z', 'roll', 'pitch', 'yaw'}


@pytest.mark.parametrize('network', ['compact', 'compact_fine'])
@pytest.mark.parametrize('name', sorted(VARIANTS))
def test_each_variant_makes_its_predictor(name, network):
    chosen = variant(name, network)
    kinds = {'plain': 'plain', 'mcd': 'mcd', 'der': 'der', 'nll': 'der', 'covariance': 'covariance'}
    assert Predictor([Cmrnet(chosen.network)]).kind == kinds[name]


def test_a_network_that_does_not_know_is_not_judged_for_it(sets):
    result = validate(Predictor([Cmrnet(SMALL)]), [SampleSet(Path(sets[1]))], per_set=5)
    assert result.errors.count == 5
    assert not result.calibration and result.ause_translation is None


def test_predictions_belong_to_their_samples(sets):
    samples = SampleSet(Path(sets[1]))
    predictor = Predictor([Cmrnet(SMALL)])
    belief, target, guesses = predictions(predictor, [samples], batch=4)
    assert len(belief) == len(target) == len(samples)
    one = samples.batch(np.array([9]))
    np.testing.assert_allclose(belief.mean[9], predictor.belief(one.image, one.lidar).mean[0],
                               atol=1e-5)  # fmt: skip
    np.testing.assert_array_equal(guesses[9], samples.guesses[9])


def test_the_thesis_variants_have_its_numbers():
    assert variant('mcd', 'full').network.dropout == 0.3
    der = variant('der', 'full')
    assert (der.loss.lambda_rotation, der.loss.lambda_translation) == (0.01, 0.1)
    assert (der.training.learning_rate, der.training.batch) == (1e-4, 24)
    nll = variant('nll', 'full').loss
    assert (nll.density, nll.geometric, nll.evidence_scale(0.9)) == ('log', False, 1.0)


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['--train', 'stepz=4'], 'no setting'),
        (['--train', 'steps=many'], 'type int'),
        (['--device', 'cuda:9'], 'cuda'),
        (['--device', 'abacus'], 'auto, cpu or cuda'),
    ],
)
def test_mistakes_are_one_line(tmp_path, sets, capsys, arguments, message):
    command = ['--samples', sets[0], '--validation', sets[1], '--out', str(tmp_path), *arguments]
    assert train.main(command) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1


def test_nothing_is_judged_by_what_it_learnt_from(tmp_path, sets, capsys):
    command = ['--samples', sets[0], '--validation', sets[0], '--out', str(tmp_path)]
    assert train.main(command) == 1
    assert 'in --samples and in --validation' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [(['towns:a-b'], 'towns:0-9'), (['street'], '--map'), (['no_drive', '--map', 'm'], 'no_drive')],
)
def test_mistakes_in_making_samples_are_one_line(tmp_path, capsys, arguments, message):
    assert make.main([*arguments, '--out', str(tmp_path / 'out')]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1
