from dataclasses import replace

import numpy as np
import pytest
import torch
from small_samples import SMALL, street_samples

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.losses import LossConfig
from cmrnet_ekf.training.trainer import Trainer, TrainingConfig, TrainingFailedError
from lcd_common.errors import ConfigError

TRAINING = TrainingConfig(steps=12, batch=4, learning_rate=1e-3, schedule='cosine')


def trainer(folder, samples, settings=TRAINING, shape=SMALL) -> Trainer:
    torch.manual_seed(0)
    return Trainer(Cmrnet(shape), [samples], folder, settings, LossConfig())


@pytest.fixture(scope='module')
def samples(tmp_path_factory):
    return street_samples(tmp_path_factory.mktemp('street'))


@pytest.mark.parametrize('head', ['quaternion', 'evidential', 'covariance'])
def test_training_makes_the_loss_small(tmp_path, samples, head):
    settings = TrainingConfig(steps=80, batch=8, learning_rate=5e-3, augment=False)
    records = list(trainer(tmp_path, samples, settings, replace(SMALL, head=head)).run())
    translation = np.array([r.translation for r in records])
    assert translation[-10:].mean() < 0.7 * translation[:5].mean()
    assert all(np.isfinite(r.total) for r in records)


def test_a_resumed_training_is_the_uninterrupted_one(tmp_path, samples):
    whole = trainer(tmp_path / 'whole', samples)
    expected = list(whole.run())
    first = trainer(tmp_path / 'parts', samples)
    list(first.run(until=5))
    second = trainer(tmp_path / 'parts', samples)
    assert second.step == 5
    rest = list(second.run())
    assert [r.total for r in rest] == [r.total for r in expected[5:]]
    for one, other in zip(whole.network.parameters(), second.network.parameters(), strict=True):
        assert torch.equal(one, other)
    assert len((tmp_path / 'parts' / 'training.jsonl').read_text().splitlines()) == 12


def test_the_rate_falls_to_a_hundredth(tmp_path, samples):
    rates = [record.learning_rate for record in trainer(tmp_path, samples).run()]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(1e-5)


def test_what_does_not_fit_is_refused(tmp_path, samples):
    with pytest.raises(ConfigError, match='make samples for this network'):
        trainer(tmp_path, samples, shape=replace(SMALL, focal=50.0))
    list(trainer(tmp_path, samples).run(until=1))
    with pytest.raises(ConfigError, match='another network'):
        trainer(tmp_path, samples, shape=replace(SMALL, hidden=20))


def test_a_loss_that_is_no_number_stops_the_training(tmp_path, samples):
    broken = trainer(tmp_path, samples)
    with torch.no_grad():
        broken.network.head.shared.weight[0] = float('nan')
    with pytest.raises(TrainingFailedError, match='step 1 '):
        list(broken.run())


def test_mixed_precision_learns_what_full_precision_does(tmp_path, samples):
    settings = TrainingConfig(steps=40, batch=8, learning_rate=5e-3, augment=False)
    shape = replace(SMALL, head='evidential')
    ends = {}
    for half in (False, True):
        chosen = replace(settings, half=half)
        records = list(trainer(tmp_path / str(half), samples, chosen, shape).run())
        ends[half] = np.mean([r.translation for r in records[-10:]])
    assert ends[True] != ends[False]
    assert ends[True] == pytest.approx(ends[False], rel=0.25)
