"""Train one network on runs of submaps; the folder keeps everything needed to go on."""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lcd_common import weights_file
from lcd_common.errors import ConfigError, LocalizationError
from lcd_common.settings import config, setting
from uncertain_place_recognition.networks.embedding import Embedding, PlaceNetwork
from uncertain_place_recognition.runs import SubmapRun
from uncertain_place_recognition.training.augmentation import AugmentationConfig, augmented
from uncertain_place_recognition.training.embedded_runs import embed_runs, points_of
from uncertain_place_recognition.training.losses import (
    MetricLoss,
    batch_hard_triplet,
    contrastive,
    distances,
    distillation,
    gaussian_likelihood,
    lazy_quadruplet,
    truncated_smooth_ap,
)
from uncertain_place_recognition.training.pairs import PairConfig, PlacePairs, Relations


class TrainingCollapsedError(LocalizationError):
    """All submaps have got the same embedding, or the loss is no number."""


@config
class TrainingConfig:
    """How a network is trained (thesis section 4.2.4 where it says it)."""

    steps: int = setting(3000, 'batches in all', low=1)
    clouds: int = setting(64, 'submaps of a batch', low=2)
    learning_rate: float = setting(0.001, "Adam's, at the start", low=1e-8)
    weight_decay: float = setting(1e-4, "Adam's", low=0.0)
    schedule: str = setting(
        'cosine', 'steps: a tenth after three quarters; cosine: down to a hundredth',
        choices=('steps', 'cosine'),
    )  # fmt: skip
    warmup: int = setting(50, 'batches over which the learning rate rises', low=0)
    loss: str = setting(
        'triplet',
        'batch-hard triplets, lazy quadruplets, smoothed average precision, all negatives at once',
        choices=('triplet', 'quadruplet', 'smooth_ap', 'contrastive'),
    )
    margin: float = setting(0.2, 'of the triplet loss', low=0.0)
    teacher_sees: str = setting(
        'changed',
        'a student learns the embedding of the changed submap that it sees, as in equation 21, or '
        'of the submap as it is, computed once',
        choices=('changed', 'plain'),
    )
    clip: float = setting(5.0, 'largest norm of the gradient; 0: any', low=0.0)
    checkpoint_every: int = setting(200, 'batches between checkpoints', low=1)
    collapse: float = setting(
        0.02, 'distance of different places, in mean norms, taken for collapse', low=0.0
    )
    collapse_after: int = setting(200, 'batches in a row until training stops for it', low=1)
    seed: int = setting(0, 'of weights and of everything drawn', low=0)


@dataclass(frozen=True)
class Step:
    """What one batch gave.

    Attributes:
        loss: in its own units.
        active: share of the anchors that violate the margin; 0 for students.
        apart: mean distance of different places, in mean norms of embeddings.
    """

    step: int
    loss: float
    active: float
    apart: float
    gradient: float
    learning_rate: float
    seconds: float


class Trainer:
    """Train by distance of places, or, with a teacher, towards its embeddings.

    Attributes:
        network: being trained.
        augmentation: of its submaps.
        step: batches done.
    """

    def __init__(
        self,
        network: PlaceNetwork,
        runs: Sequence[SubmapRun],
        folder: Path,
        settings: TrainingConfig,
        *,
        teacher: PlaceNetwork | None = None,
        augmentation: AugmentationConfig | None = None,
        pairs: PairConfig | None = None,
        device: torch.device | str = 'cpu',
    ) -> None:
        """Prepare, or resume where the folder's checkpoint stands.

        Args:
            network: untrained, or trained before.
            runs: to learn from.
            folder: for the checkpoint and the log.
            settings: of the training.
            teacher: whose embeddings are learnt; None: places are told apart.
            augmentation: of submaps.
            pairs: radii.
            device: to train on.

        Raises:
            ConfigError: a teacher's embeddings have another length, or the checkpoint is of another
                network or training.
        """
        self.settings, self.folder, self._runs = settings, folder, runs
        self.augmentation = augmentation or AugmentationConfig()
        self.device = torch.device(device)
        self.network = network.to(self.device)
        self._pairs = PlacePairs(runs, pairs)
        self._teacher = None if teacher is None else teacher.to(self.device).eval()
        if teacher is not None and teacher.settings.size != network.settings.size:
            raise ConfigError(
                f"a student learns embeddings as long as its teacher's, {teacher.settings.size}, "
                f'not {network.settings.size}'
            )
        self._targets: Tensor | None = None
        if self._teacher is not None and settings.teacher_sees == 'plain':
            # The mirror image of a place is another place.
            self.augmentation = replace(self.augmentation, flip=0.0)
            found = np.concatenate(embed_runs(self._teacher, runs, self.device))
            self._targets = torch.from_numpy(found).to(self.device)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.step, self._collapsed = 0, 0
        if self.checkpoint_path.exists():
            self._resume()

    @property
    def checkpoint_path(self) -> Path:
        """Where training goes on from."""
        return self.folder / 'checkpoint.safetensors'

    def run(self, until: int | None = None, deadline: float | None = None) -> Iterator[Step]:
        """Train up to a step, or until `time.monotonic()` passes a deadline; yield each step.

        Raises:
            TrainingCollapsedError: embeddings have all become alike, or the loss is no number.
        """
        s = self.settings
        last = s.steps if until is None else min(until, s.steps)
        self.folder.mkdir(parents=True, exist_ok=True)
        while self.step < last and (deadline is None or time.monotonic() < deadline):
            record = self._train_step()
            with (self.folder / 'training.jsonl').open('a') as log:
                log.write(json.dumps({k: _short(v) for k, v in asdict(record).items()}) + '\n')
            self._watch(record)
            if self.step % s.checkpoint_every == 0 and self.step < last:
                self.save()
            yield record
        self.save()

    def save(self) -> None:
        """Write a checkpoint."""
        facts = {
            'step': self.step,
            'collapsed': self._collapsed,
            'training': asdict(self.settings),
            'config': asdict(self.network.settings),
        }
        tensors = weights_file.train_state(self.network, self.optimizer)
        weights_file.write(self.checkpoint_path, tensors, facts)

    def _resume(self) -> None:
        stored = weights_file.read(self.checkpoint_path)
        for name, mine in (('training', self.settings), ('config', self.network.settings)):
            theirs = stored.facts[name]
            changed = [k for k, v in json.loads(json.dumps(asdict(mine))).items()
                       if theirs.get(k) != v]  # fmt: skip
            if changed:
                raise ConfigError(
                    f'{self.folder} holds a training with another {", ".join(changed)}; go on with '
                    'the same settings, or choose another --out'
                )
        weights_file.restore(self.network, self.optimizer, stored.tensors)
        self.step, self._collapsed = int(stored.facts['step']), int(stored.facts['collapsed'])

    def _learning_rate(self) -> float:
        s, share = self.settings, self.step / self.settings.steps
        rate = s.learning_rate * min(1.0, (self.step + 1) / max(s.warmup, 1))
        if s.schedule == 'cosine':
            return rate * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * share))))
        return rate * (0.1 if share >= 0.75 else 1.0)

    def _train_step(self) -> Step:
        begin, s = time.monotonic(), self.settings
        # By step, so that a resumed training draws what it would have drawn.
        rng = np.random.default_rng([s.seed, self.step])
        generator = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
        torch.manual_seed(int(rng.integers(1 << 62)))  # dropout
        chosen = self._chosen(rng)
        plain = points_of(self._points(chosen), self.device)
        points = augmented(plain, self.augmentation, generator)
        for group in self.optimizer.param_groups:
            group['lr'] = self._learning_rate()
        self.network.train()
        found: Embedding = self.network(self.network.prepare(points))
        relations = self._pairs.relations(chosen)
        if self._teacher is None:
            result = self._metric_loss(found.mean, relations, generator)
        else:
            result = MetricLoss(self._student_loss(found, chosen, points), 0.0)
        self.optimizer.zero_grad(set_to_none=True)
        result.loss.backward()  # type: ignore[no-untyped-call]
        limit = s.clip or float('inf')
        gradient = float(nn.utils.clip_grad_norm_(self.network.parameters(), limit))
        if np.isfinite(gradient):
            self.optimizer.step()
        self.step += 1
        return Step(
            self.step,
            float(result.loss.detach()),
            result.active,
            _apart(found.mean.detach(), relations),
            gradient,
            self.optimizer.param_groups[0]['lr'],
            time.monotonic() - begin,
        )

    def _chosen(self, rng: np.random.Generator) -> NDArray[np.intp]:
        count = self.settings.clouds
        if self._teacher is None:
            return self._pairs.draw(count // 2, rng)
        # Students see every submap once in an epoch, in an order of their own.
        total = len(self._pairs)
        count = min(count, total)
        epoch, part = divmod(self.step, max(1, total // count))
        order = np.random.default_rng([self.settings.seed, 17, epoch]).permutation(total)
        return order[part * count : (part + 1) * count]

    def _points(self, chosen: NDArray[np.intp]) -> NDArray[np.float16]:
        pairs = self._pairs
        return np.stack([self._runs[pairs.run[k]].points[pairs.at[k]] for k in chosen])

    def _metric_loss(
        self, embeddings: Tensor, relations: Relations, generator: torch.Generator
    ) -> MetricLoss:
        positive = torch.from_numpy(relations.positive).to(self.device)
        negative = torch.from_numpy(relations.negative).to(self.device)
        if self.settings.loss == 'triplet':
            return batch_hard_triplet(embeddings, positive, negative, self.settings.margin)
        if self.settings.loss == 'quadruplet':
            return lazy_quadruplet(embeddings, positive, negative, generator)
        if self.settings.loss == 'smooth_ap':
            return truncated_smooth_ap(embeddings, positive, negative)
        return contrastive(embeddings, positive, negative)

    def _student_loss(self, found: Embedding, chosen: NDArray[np.intp], points: Tensor) -> Tensor:
        if self._targets is not None:
            target = self._targets[torch.from_numpy(chosen).to(self.device)]
        else:
            assert self._teacher is not None
            with torch.no_grad():
                target = self._teacher.embed(points)
        if found.variance is None:
            return distillation(found.mean, target)
        return gaussian_likelihood(found.mean, found.variance, target)

    def _watch(self, record: Step) -> None:
        if not np.isfinite(record.loss):
            raise TrainingCollapsedError(
                f'the loss of step {record.step} is no number; begin anew, learning_rate lower'
            )
        alike = record.apart < self.settings.collapse
        self._collapsed = self._collapsed + 1 if alike else 0
        if self._collapsed >= self.settings.collapse_after:
            raise TrainingCollapsedError(
                f'embeddings of different places lie {record.apart:.4f} of their length apart at '
                f'step {record.step}: all places look alike; use larger batches (clouds), a lower '
                'learning_rate, or a larger radius of positives for small submaps'
            )


def _apart(embeddings: Tensor, relations: Relations) -> float:
    """Return the mean distance of different places in mean norms; infinity if all are one."""
    if not relations.negative.any():
        return float('inf')
    mask = torch.from_numpy(relations.negative).to(embeddings.device)
    norm = embeddings.norm(dim=1).mean().clamp(min=1e-12)
    return float(distances(embeddings)[mask].mean() / norm)


def _short(value: float) -> float:
    return value if isinstance(value, int) else float(f'{value:.5g}')
