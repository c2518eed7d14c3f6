"""Training: recall rises, students come nearer to their teacher, resuming is going through."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import small_run

from lcd_common.errors import ConfigError
from uncertain_place_recognition.networks.shapes import build, shape
from uncertain_place_recognition.training.augmentation import AugmentationConfig
from uncertain_place_recognition.training.embedded_runs import embed_runs
from uncertain_place_recognition.training.pairs import PairConfig
from uncertain_place_recognition.training.trainer import (
    Trainer,
    TrainingCollapsedError,
    TrainingConfig,
)

RUNS = [
    small_run('a', 'w', points=64, spacing_m=10.0),
    small_run('b', 'w', points=64, spacing_m=10.0),
    small_run('c', 'v', points=64, spacing_m=10.0),
]
SHAPE = shape('bev_netvlad', rows=8, columns=16, widths=(6, 8), blocks=(1, 1), clusters=4, size=8)
AUGMENTATION = AugmentationConfig(yaw=10.0, flip=0.0, erased=0.0)
PAIRS = PairConfig(positive=11.0, negative=35.0)


def _network(seed=0, settings=SHAPE):
    torch.manual_seed(seed)
    return build(settings)


def _trainer(folder, network=None, **values):
    teacher = values.pop('teacher', None)
    settings = TrainingConfig(**{'steps': 12, 'clouds': 12, 'warmup': 1, **values})
    return Trainer(
        network or _network(), RUNS, folder, settings,
        teacher=teacher, augmentation=AUGMENTATION, pairs=PAIRS,
    )  # fmt: skip


@pytest.mark.parametrize('loss', ['triplet', 'quadruplet', 'smooth_ap', 'contrastive'])
def test_training_lowers_the_loss(tmp_path, loss):
    trainer = _trainer(tmp_path, steps=60, loss=loss, learning_rate=0.01)
    records = list(trainer.run())
    # The mean over triplets that are left does not fall as their number does.
    cost = [r.loss * (r.active if loss == 'triplet' else 1.0) for r in records]
    assert np.mean(cost[-10:]) < 0.7 * np.mean(cost[:10])
    assert trainer.step == 60 and records[-1].apart > 0.1


@pytest.mark.parametrize('student', [False, True])
def test_resuming_is_going_through(tmp_path, student):
    teacher = _network(9).eval() if student else None
    through = _trainer(tmp_path / 'through', teacher=teacher)
    whole = list(through.run())
    first = _trainer(tmp_path / 'parts', teacher=teacher)
    parts = list(first.run(until=5))
    # Other weights at the start: all must come from the checkpoint.
    second = _trainer(tmp_path / 'parts', _network(7), teacher=teacher)
    assert second.step == 5
    parts += list(second.run())
    assert [r.loss for r in parts] == [r.loss for r in whole]
    for one, other in zip(
        through.network.state_dict().values(), second.network.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert len((tmp_path / 'parts' / 'training.jsonl').read_text().splitlines()) == 12
    assert list(_trainer(tmp_path / 'parts', teacher=teacher).run()) == []


@pytest.mark.parametrize('sees', ['plain', 'changed'])
def test_distillation_closes_the_gap(tmp_path, sees):
    teacher = _network(1).train()
    for run in RUNS:
        teacher.embed(torch.from_numpy(run.points.astype(np.float32)))
    target = np.concatenate(embed_runs(teacher, RUNS))
    student = _network(2)

    def gap():
        return np.linalg.norm(np.concatenate(embed_runs(student, RUNS)) - target, axis=1).mean()

    trainer = _trainer(
        tmp_path, student, teacher=teacher, steps=150, learning_rate=0.02, teacher_sees=sees
    )
    before = [p.clone() for p in teacher.parameters()]
    begin = gap()
    records = list(trainer.run())
    assert gap() < 0.4 * begin
    assert np.mean([r.loss for r in records[-10:]]) < 0.4 * records[0].loss
    for one, other in zip(before, teacher.parameters(), strict=True):
        assert torch.equal(one, other)  # the teacher stays as it is


def test_a_student_with_a_head_learns_a_variance(tmp_path):
    teacher = _network(1).eval()
    student = _network(2, replace(SHAPE, variance=True))
    trainer = _trainer(tmp_path, student, teacher=teacher, steps=30, learning_rate=0.01)
    records = list(trainer.run())
    assert np.mean([r.loss for r in records[-5:]]) < np.mean([r.loss for r in records[:5]]) - 0.8


def test_students_see_every_submap_once_in_an_epoch_in_an_order_of_their_own(tmp_path, monkeypatch):
    seen = {}
    for seed in (1, 2):
        trainer = _trainer(tmp_path / str(seed), teacher=_network().eval(), seed=seed, steps=3)
        drawn = []
        plain = trainer._points
        monkeypatch.setattr(trainer, '_points', lambda c, d=drawn, p=plain: (d.append(c), p(c))[1])
        list(trainer.run())
        assert sorted(np.concatenate(drawn).tolist()) == list(range(36))
        seen[seed] = np.concatenate(drawn).tolist()
    assert seen[1] != seen[2]


def test_a_mirrored_submap_is_not_taken_for_the_plain_one(tmp_path):
    teacher, flipping = _network().eval(), AugmentationConfig(flip=0.5)
    for sees, flip in (('plain', 0.0), ('changed', 0.5)):
        settings = TrainingConfig(teacher_sees=sees)
        trainer = Trainer(
            _network(), RUNS, tmp_path, settings, teacher=teacher, augmentation=flipping,
            pairs=PAIRS,
        )  # fmt: skip
        assert trainer.augmentation.flip == flip


def test_a_collapse_is_an_alarm(tmp_path):
    network = _network()
    trainer = _trainer(tmp_path, network, collapse=10.0, collapse_after=3, steps=50)
    with pytest.raises(TrainingCollapsedError, match='all places look alike'):
        list(trainer.run())
    assert trainer.step == 3
    with torch.no_grad():
        network.vlad.compress.fill_(torch.nan)
    with pytest.raises(TrainingCollapsedError, match='no number'):
        list(_trainer(tmp_path / 'nan', network).run())


def test_what_does_not_fit_is_refused(tmp_path):
    with pytest.raises(ConfigError, match='as long as its teacher'):
        _trainer(tmp_path, teacher=_network(0, replace(SHAPE, size=4)))
    list(_trainer(tmp_path).run(until=2))
    with pytest.raises(ConfigError, match='another learning_rate'):
        _trainer(tmp_path, learning_rate=0.5)
