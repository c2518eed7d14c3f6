"""Training: losses fall, stopping and going on changes nothing, collapse is told."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from lcdnet_samples import TINY, street_shard

from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure.lcdnet import Lcdnet, checkpoint, train
from lcd_loop_closure.lcdnet.curves import draw_curves
from lcd_loop_closure.lcdnet.training import Trainer, TrainingCollapsedError, TrainingConfig
from lcd_loop_closure.lcdnet.validation import validate
from lcd_loop_closure.lcdnet.voxels import Clouds

SHORT = TrainingConfig(
    steps=60, places=3, learning_rate=0.005, warmup=5, schedule='cosine', pose_weight=0.05,
    matching_weight=1.0, checkpoint_every=4,
)  # fmt: skip
SHARDS = [street_shard(town) for town in (11, 12)]


def _network():
    torch.manual_seed(0)
    return Lcdnet(TINY)


def test_losses_fall_and_the_log_tells(tmp_path):
    records = list(Trainer(_network(), SHARDS, tmp_path, SHORT).run())
    assert [r.step for r in records] == list(range(1, 61))
    first, last = records[:10], records[-10:]
    for name in ('total', 'matching'):
        before = np.mean([getattr(r, name) for r in first])
        assert np.mean([getattr(r, name) for r in last]) < 0.9 * before
    rows = [json.loads(line) for line in (tmp_path / 'training.jsonl').read_text().splitlines()]
    assert len(rows) == 60 and rows[-1]['total'] == pytest.approx(last[-1].total, rel=1e-3)
    draw_curves(tmp_path)
    assert (tmp_path / 'curves.png').stat().st_size > 5000


def test_training_goes_on_where_it_stopped(tmp_path):
    whole = list(
        Trainer(_network(), SHARDS, tmp_path / 'a', _short_in(tmp_path / 'a')).run(until=6)
    )
    folder = tmp_path / 'b'
    list(Trainer(_network(), SHARDS, folder, _short_in(folder)).run(until=4))
    torch.manual_seed(99)
    resumed = Trainer(Lcdnet(TINY), SHARDS, folder, SHORT)
    assert resumed.step == 4
    rest = list(resumed.run(until=6))
    assert [r.total for r in rest] == pytest.approx([r.total for r in whole[4:]], rel=1e-5)


def _short_in(folder):
    folder.mkdir()
    return SHORT


def test_the_thesis_halves_the_learning_rate_twice(tmp_path):
    settings = TrainingConfig(steps=150, warmup=0)
    trainer = Trainer(_network(), SHARDS, tmp_path, settings)
    rates = {}
    for step in (0, 39, 40, 79, 80, 149):
        trainer.step = step
        rates[step] = trainer._learning_rate()
    assert rates == {0: 4e-3, 39: 4e-3, 40: 2e-3, 79: 2e-3, 80: 1e-3, 149: 1e-3}


def test_collapse_stops_training(tmp_path):
    network = _network()
    with torch.no_grad():
        network.place.compress.zero_()  # every cloud now gets the same descriptor
        network.place.compress_norm.bias.fill_(1.0)
    settings = replace(SHORT, learning_rate=1e-7, collapse_after=3)
    with pytest.raises(TrainingCollapsedError, match='all places look alike'):
        list(Trainer(network, SHARDS, tmp_path, settings).run())


def test_mixed_precision_runs_and_learns_the_same_way(tmp_path):
    record = next(iter(Trainer(_network(), SHARDS, tmp_path, replace(SHORT, half=True)).run()))
    full = next(iter(Trainer(_network(), SHARDS, tmp_path / 'x', _short_in(tmp_path / 'x')).run()))
    assert record.total == pytest.approx(full.total, rel=0.1)


def test_networks_come_back_from_their_files(tmp_path):
    network = _network().eval()
    path = tmp_path / 'w.safetensors'
    checkpoint.save_network(path, network, {'trained_on': 'nothing'})
    back, facts = checkpoint.load_network(path)
    assert facts['trained_on'] == 'nothing' and back.settings == TINY and not back.training
    cloud = Clouds.of([torch.from_numpy(SHARDS[0].place(0).sweeps[0].xyz)])
    with torch.no_grad():
        torch.testing.assert_close(network(cloud).descriptors, back(cloud).descriptors)
    checkpoint.save_network(path, network, {}, half=True)
    halved, _ = checkpoint.load_network(path)
    with torch.no_grad():
        near = network(cloud).descriptors - halved(cloud).descriptors
    assert float(near.abs().max()) < 5e-3
    path.write_bytes(b'no weights at all')
    with pytest.raises(DataError, match='train_lcdnet'):
        checkpoint.load_network(path)


def test_validation_sees_a_perfect_network_as_perfect():
    result = validate(_network(), SHARDS, 2)
    assert result.places == 4
    assert 0.0 <= result.average_precision <= 1.0 and 0.0 <= result.recall_1 <= 1.0
    assert 0.0 <= result.loops_success <= 1.0


def test_the_command_trains_resumes_and_keeps_the_best(tmp_path, capsys):
    data, out = tmp_path / 'data', tmp_path / 'run'
    data.mkdir()
    for town in (0, 1, 100):
        street_shard(town, 3).save(train.shard_path(data, town))
    tiny = [
        f'{name}={",".join(map(str, value)) if isinstance(value, tuple) else value}'
        for name, value in vars(TINY).items()
    ]
    command = [
        '--out', str(out), '--data', str(data), '--towns', '2', '--validation-towns', '1',
        '--validation-places', '2', '--validate-every', '2', '--quiet', '--device', 'cpu',
        '--set', *tiny, '--train', 'places=2', 'warmup=1',
    ]  # fmt: skip
    assert train.main([*command, 'steps=2']) == 0
    assert train.main([*command, 'steps=4']) == 0
    rows = [json.loads(line) for line in (out / 'validation.jsonl').read_text().splitlines()]
    assert [row['step'] for row in rows] == [2, 4]
    network, facts = checkpoint.load_network(out / 'best.safetensors')
    assert network.settings == TINY
    assert facts['validation']['score'] == max(row['score'] for row in rows)
    assert json.loads((out / 'best.json').read_text()) == {
        key: value for key, value in facts.items() if key != 'config'
    }


def test_mistakes_are_one_line(tmp_path, capsys):
    assert train.main(['--out', str(tmp_path), '--train', 'sleep=1']) == 1
    assert 'is no setting' in capsys.readouterr().err
    assert train.main(['--out', str(tmp_path), '--train', 'steps=many']) == 1
    assert 'expected a value of type int' in capsys.readouterr().err
    with pytest.raises(ConfigError, match='device must be'):
        choose_device('abacus')
