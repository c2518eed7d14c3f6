"""Check how the network is fine-tuned on the real street."""

from dataclasses import replace

import torch

from benchmarks import cmrnet_real
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.training.variants import variant


def test_fine_tuning_goes_on_by_the_loss_of_the_training(tmp_path, monkeypatch):
    given = {}

    class Trainer:
        step = 0

        def __init__(self, network, sets, folder, settings, loss):
            given.update(network=network, sets=sets, settings=settings, loss=loss)

        def run(self):
            with torch.no_grad():
                given['network'].head.shared.bias += 1.0
            yield 1

    monkeypatch.setattr(cmrnet_real, 'Trainer', Trainer)
    network = Cmrnet(replace(COMPACT, head='evidential'))
    before = network.head.shared.bias.clone()
    tuned = cmrnet_real.fine_tuned(tmp_path / 'tuned', network, 'samples', 7)
    trained = variant('der', 'compact').loss
    assert given['loss'] == replace(trained, evidence_first=trained.evidence_second)
    assert given['loss'].unit_rotation < 1.0
    assert given['settings'].steps == 7 and given['sets'] == ['samples']
    assert torch.equal(network.head.shared.bias, before), 'the network that was given stays'
    assert tuned.kind == 'der'
