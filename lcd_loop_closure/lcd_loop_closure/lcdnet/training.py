"""Train the network: steps, schedule, checkpoints and the alarm for collapse."""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from lcd_common import weights_file
from lcd_common.errors import LocalizationError
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig
from lcd_loop_closure.lcdnet.batches import Batch, draw_batch
from lcd_loop_closure.lcdnet.losses import (
    Losses,
    matching_loss,
    pose_loss,
    transport_loss,
    triplet_loss,
)
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import PlaceShard
from lcd_loop_closure.lcdnet.weighted_svd import weighted_svd


class TrainingCollapsedError(LocalizationError):
    """All clouds have got the same descriptor, or the loss is no number."""


@config
class TrainingConfig:
    """How the network is trained; what the thesis says (section 3.3.2) where it says it."""

    steps: int = setting(20000, 'batches in all', low=1)
    places: int = setting(24, 'places of a batch, over all processes', low=2)
    learning_rate: float = setting(0.004, "Adam's, at the start", low=1e-7)
    weight_decay: float = setting(5e-6, "Adam's", low=0.0)
    schedule: str = setting(
        'steps',
        'steps: halved after 40/150 and 80/150 of the training, as in the thesis; cosine: down to '
        'a hundredth',
        choices=('steps', 'cosine'),
    )
    warmup: int = setting(200, 'batches over which the learning rate rises', low=0)
    margin: float = setting(0.5, 'm of the triplet loss', low=0.0)
    hardest: bool = setting(False, 'take the hardest negative of the batch, not a violating one')
    beta: float = setting(0.05, 'weight of the transport loss', low=0.0)
    pose_weight: float = setting(1.0, 'weight of the pose loss', low=0.0)
    matching_weight: float = setting(
        0.0, 'weight of the matching loss, which is not in the thesis', low=0.0
    )
    keypoints: int = setting(0, 'keypoints of a cloud while training; 0: as configured', low=0)
    clip: float = setting(5.0, 'largest norm of the gradient', low=0.0)
    half: bool = setting(False, 'mixed precision (bfloat16)')
    checkpoint_every: int = setting(100, 'batches between checkpoints', low=1)
    collapse_distance: float = setting(
        0.05, 'mean distance of descriptors of different places that is taken for collapse', low=0.0
    )
    collapse_after: int = setting(300, 'batches in a row until training stops for it', low=1)
    seed: int = setting(0, 'of weights and of everything drawn', low=0)


@dataclass(frozen=True)
class Step:
    """What one batch gave; losses in their own units, before weights."""

    step: int
    total: float
    triplet: float
    pose_m: float
    transport_m: float
    matching: float
    violated_share: float
    different_distance: float
    gradient: float
    learning_rate: float
    seconds: float


class Trainer:
    """Train a network on shards of places; the folder keeps everything needed to go on."""

    def __init__(
        self,
        network: Lcdnet,
        shards: Sequence[PlaceShard],
        folder: Path,
        settings: TrainingConfig,
        augmentation: AugmentationConfig | None = None,
        *,
        device: torch.device | str = 'cpu',
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        """Prepare, or resume where the folder's checkpoint stands.

        Args:
            network: untrained, or trained before.
            shards: to learn from.
            folder: for checkpoints and the log.
            settings: of the training.
            augmentation: of sweeps.
            device: to train on.
            rank, processes: of this process among those of torchrun; each draws its own share of
                the places, gradients are averaged.
        """
        self.settings, self.folder = settings, folder
        self._shards, self._augmentation = shards, augmentation or AugmentationConfig()
        self.device, self._rank, self._processes = torch.device(device), rank, processes
        self.network = network.to(self.device)
        if processes > 1 and self.device.type == 'cuda':
            self.network = nn.SyncBatchNorm.convert_sync_batchnorm(self.network)
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
            TrainingCollapsedError: descriptors have all become alike, or the loss is no number.
        """
        s = self.settings
        last = s.steps if until is None else min(until, s.steps)
        while self.step < last and (deadline is None or time.monotonic() < deadline):
            record = self._train_step()
            if self._rank == 0:
                with (self.folder / 'training.jsonl').open('a') as log:
                    log.write(json.dumps({k: _short(v) for k, v in asdict(record).items()}) + '\n')
            self._watch(record)
            if self.step % s.checkpoint_every == 0 or self.step == last:
                self.save()
            yield record
        self.save()

    def save(self) -> None:
        """Write a checkpoint."""
        if self._rank == 0:
            weights_file.write(
                self.checkpoint_path,
                weights_file.train_state(self.network, self.optimizer),
                {'step': self.step, 'training': asdict(self.settings),
                 'config': asdict(self.network.settings)},
            )  # fmt: skip

    def _resume(self) -> None:
        stored = weights_file.read(self.checkpoint_path)
        weights_file.restore(self.network, self.optimizer, stored.tensors)
        self.step = int(stored.facts['step'])

    def _learning_rate(self) -> float:
        s, share = self.settings, self.step / self.settings.steps
        rate = s.learning_rate * min(1.0, (self.step + 1) / max(s.warmup, 1))
        if s.schedule == 'cosine':
            return rate * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * share))))
        return rate * 0.5 ** ((share >= 40 / 150) + (share >= 80 / 150))

    def _train_step(self) -> Step:
        begin, s = time.monotonic(), self.settings
        # By step, so that a resumed training draws what it would have drawn.
        rng = np.random.default_rng([s.seed, self.step, self._rank])
        torch.manual_seed(int(rng.integers(1 << 62)))
        places = max(2, s.places // self._processes)
        batch = draw_batch(self._shards, places, self._augmentation, rng).to(self.device)
        for group in self.optimizer.param_groups:
            group['lr'] = self._learning_rate()
        self.network.train()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=s.half):
            losses, matching, apart = self._losses(batch, rng)
        total = losses.total(s.beta, s.pose_weight) + s.matching_weight * matching
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        if self._processes > 1:
            for parameter in self.network.parameters():
                if parameter.grad is not None:
                    torch.distributed.all_reduce(parameter.grad)
                    parameter.grad /= self._processes
        limit = s.clip or float('inf')
        gradient = float(nn.utils.clip_grad_norm_(self.network.parameters(), limit))
        if np.isfinite(gradient):
            self.optimizer.step()
        self.step += 1
        return Step(
            self.step,
            float(total.detach()),
            float(losses.triplet.detach()),
            float(losses.pose.detach()),
            float(losses.transport.detach()),
            float(matching.detach()),
            losses.violated,
            apart,
            gradient,
            self._learning_rate(),
            time.monotonic() - begin,
        )

    def _losses(self, batch: Batch, rng: np.random.Generator) -> tuple[Losses, torch.Tensor, float]:
        s = self.settings
        features = self.network(batch.clouds, keypoints=s.keypoints or None, generator=rng)
        loops = slice(0, batch.loops)
        descriptors = features.descriptors.float()
        triplet, violated = triplet_loss(
            descriptors, batch.source[loops], batch.target[loops], batch.different, s.margin,
            s.hardest,
        )  # fmt: skip
        points = features.keypoints[batch.source].float()
        matches = self.network.match(features, batch.source, batch.target)
        matching = transport = triplet.new_zeros(())
        if matches is None:
            T = self.network.relative_pose(features, batch.source, batch.target)
        else:
            T = weighted_svd(points, matches.projected, matches.weight)
            transport = transport_loss(matches, points, batch.T_target_source)
        pose = pose_loss(points, T, batch.T_target_source)
        losses = Losses(triplet, pose, transport, violated)
        if s.matching_weight:
            unit = nn.functional.normalize(features.features.float(), dim=2)
            matching = matching_loss(
                unit[batch.source] @ unit[batch.target].transpose(1, 2),
                points,
                features.keypoints[batch.target].float(),
                batch.T_target_source,
            )
        distance = torch.cdist(descriptors.detach(), descriptors.detach())
        return losses, matching, float(distance[batch.different].mean())

    def _watch(self, record: Step) -> None:
        if not np.isfinite(record.total):
            raise TrainingCollapsedError(
                f'the loss of step {record.step} is no number; lower learning_rate and resume'
            )
        alike = record.different_distance < self.settings.collapse_distance
        self._collapsed = self._collapsed + 1 if alike else 0
        if self._collapsed >= self.settings.collapse_after:
            raise TrainingCollapsedError(
                f'descriptors of different places lie {record.different_distance:.3f} apart at '
                f'step {record.step}: all places look alike; use more places in a batch or a lower '
                'learning_rate'
            )


def _short(value: float) -> float:
    return value if isinstance(value, int) else float(f'{value:.5g}')
