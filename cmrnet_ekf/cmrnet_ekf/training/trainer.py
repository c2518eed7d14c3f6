"""Train a network: steps, schedule, checkpoints."""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.losses import LossConfig, pose_losses
from cmrnet_ekf.networks.matching import cell_matches, matching_loss
from cmrnet_ekf.training.batch import Batch
from cmrnet_ekf.training.sample_set import SampleSet, draw
from lcd_common import weights_file
from lcd_common.errors import ConfigError, LocalizationError
from lcd_common.settings import config, setting


class TrainingFailedError(LocalizationError):
    """The loss is no number."""


@config
class TrainingConfig:
    """How the network is trained; the defaults are CMRNet's and the thesis's (section 5.3.2)."""

    steps: int = setting(190_000, 'batches in all (thesis: 400 epochs of 11,426 samples)', low=1)
    batch: int = setting(24, 'samples of a batch', low=1)
    learning_rate: float = setting(1e-4, "Adam's", low=1e-8)
    weight_decay: float = setting(5e-6, "Adam's", low=0.0)
    schedule: str = setting(
        'constant', 'constant, or cosine: down to a hundredth', choices=('constant', 'cosine')
    )
    augment: bool = setting(True, 'mirror, vary colours, and roll')
    roll: float = setting(
        5.0, 'largest roll of both images when augmented', unit='deg', low=0.0, high=45.0
    )
    clip: float = setting(10.0, 'largest norm of the gradient; 0: none', low=0.0)
    half: bool = setting(False, 'mixed precision (bfloat16); the heads stay in full')
    checkpoint_every: int = setting(500, 'batches between checkpoints', low=1)
    seed: int = setting(0, 'of weights and of everything drawn', low=0)


@dataclass(frozen=True)
class Step:
    """What one batch gave; losses before weights."""

    step: int
    total: float
    translation: float
    rotation: float
    evidence: float
    matching: float
    gradient: float
    learning_rate: float
    seconds: float


class Trainer:
    """Train a network on samples; the folder keeps everything needed to go on."""

    def __init__(
        self,
        network: Cmrnet,
        sets: Sequence[SampleSet],
        folder: Path,
        settings: TrainingConfig,
        loss: LossConfig,
        device: torch.device | str = 'cpu',
    ) -> None:
        """Prepare, or resume where the folder's checkpoint stands.

        Raises:
            ConfigError: the samples are not of the images that the network takes, or the
                checkpoint is another network's.
        """
        self.settings, self.folder, self._loss = settings, folder, loss
        self._sets = list(sets)
        rolls = settings.augment and settings.roll > 0.0
        for one in self._sets:
            if one.images != tuple(network.settings.images):
                raise ConfigError(
                    f'{one.path}: samples of images {one.images}, the network takes '
                    f'{network.settings.images}; make samples for this network'
                )
            if (loss.matching_weight or rolls) and not one.pinhole:
                raise ConfigError(
                    f'{one.path}: the matching loss and rolled images need images without '
                    'distortion and samples that say of which camera; rectify them, or set '
                    '--loss matching_weight=0 and --train roll=0'
                )
        self.device = torch.device(device)
        self.network = network.to(self.device)
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )
        self.step = 0
        folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint_path.exists():
            self._resume()

    @property
    def checkpoint_path(self) -> Path:
        """Where training goes on from."""
        return self.folder / 'checkpoint.safetensors'

    def run(self, until: int | None = None, deadline: float | None = None) -> Iterator[Step]:
        """Train up to a step, or until `time.monotonic()` passes a deadline; yield each step.

        Raises:
            TrainingFailedError: the loss is no number.
        """
        s = self.settings
        last = s.steps if until is None else min(until, s.steps)
        while self.step < last and (deadline is None or time.monotonic() < deadline):
            record = self._train_step()
            with (self.folder / 'training.jsonl').open('a') as log:
                log.write(json.dumps({k: _short(v) for k, v in asdict(record).items()}) + '\n')
            if not np.isfinite(record.total):
                raise TrainingFailedError(
                    f'the loss of step {record.step} is no number; lower learning_rate and resume '
                    f'from {self.checkpoint_path}'
                )
            if self.step % s.checkpoint_every == 0 or self.step == last:
                self.save()
            yield record
        self.save()

    def save(self) -> None:
        """Write a checkpoint."""
        weights_file.write(
            self.checkpoint_path,
            weights_file.train_state(self.network, self.optimizer),
            {
                'step': self.step,
                'training': asdict(self.settings),
                'loss': asdict(self._loss),
                'config': asdict(self.network.settings),
            },
        )

    def _resume(self) -> None:
        stored = weights_file.read(self.checkpoint_path)
        try:
            weights_file.restore(self.network, self.optimizer, stored.tensors)
            self.step = int(stored.facts['step'])
        except (RuntimeError, KeyError, ValueError) as error:
            raise ConfigError(
                f'{self.checkpoint_path}: of another network; choose another folder ({error})'
            ) from error

    def _learning_rate(self) -> float:
        s, share = self.settings, self.step / self.settings.steps
        if s.schedule == 'cosine':
            return s.learning_rate * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * share))))
        return s.learning_rate

    def _train_step(self) -> Step:
        begin, s = time.monotonic(), self.settings
        # By step, so that a resumed training draws what it would have drawn.
        rng = np.random.default_rng([s.seed, self.step])
        torch.manual_seed(int(rng.integers(1 << 62)))
        roll = float(np.deg2rad(s.roll)) if s.augment else None
        batch = draw(self._sets, s.batch, rng, roll).to(self.device)
        for group in self.optimizer.param_groups:
            group['lr'] = self._learning_rate()
        self.network.train()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=s.half):
            correlation = self.network.correlation(batch.image, batch.lidar)
            output = self.network.head(self.network.features(correlation, batch.lidar))
        evidence = self._loss.evidence_scale(self.step / s.steps)
        losses = pose_losses(output, batch.target, self._loss, evidence)
        matching = self._matching(correlation, batch)
        total = losses.total + self._loss.matching_weight * matching
        self.optimizer.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        limit = s.clip or float('inf')
        gradient = float(nn.utils.clip_grad_norm_(self.network.parameters(), limit))
        if np.isfinite(gradient):
            self.optimizer.step()
        self.step += 1
        return Step(
            self.step,
            float(total.detach()),
            float(losses.translation.detach()),
            float(losses.rotation.detach()),
            float(losses.evidence.detach()),
            float(matching.detach()),
            gradient,
            self._learning_rate(),
            time.monotonic() - begin,
        )

    def _matching(self, correlation: Tensor, batch: Batch) -> Tensor:
        if not self._loss.matching_weight:
            return correlation.new_zeros(())
        rows, columns = correlation.shape[2:]
        displacement = self.network.settings.displacement
        matches = cell_matches(
            batch.lidar, batch.target, batch.camera, (rows, columns), displacement
        )
        return matching_loss(correlation, matches, self._loss.matching_sharpness)


def _short(value: float) -> float:
    return value if isinstance(value, int) else float(f'{value:.5g}')
