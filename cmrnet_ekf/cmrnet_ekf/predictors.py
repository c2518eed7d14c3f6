"""Predict poses with uncertainty: one network, MC dropout, a deep ensemble, or evidence."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from cmrnet_ekf import euler
from cmrnet_ekf.networks.checkpoint import load_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.outputs import Evidence, GaussianPose, Output, QuaternionPose
from cmrnet_ekf.pose_belief import PoseBelief, gaussian_of_samples
from cmrnet_ekf.pose_sampling import NoiseRange
from lcd_common.errors import ConfigError, DataError
from lcd_common.se3 import Array

# Compact networks with evidential regression, one after the other; see their cards. Trained on
# simulated towns only.
SHIPPED = tuple(
    Path(__file__).parent / 'weights' / f'{name}.safetensors'
    for name in ('der', 'second/der', 'third/der')
)


class Predictor:
    """Say where cameras are; what `belief` makes of the networks depends on what they are.

    One network with a quaternion head and dropout is asked many times (MC dropout), several are an
    ensemble, an evidential or covariance head speaks for itself. One plain network alone gives a
    scale of 0: it does not know.
    """

    def __init__(
        self,
        networks: Sequence[Cmrnet],
        samples: int = 30,
        seed: int = 0,
        trained_for: NoiseRange | None = None,
    ) -> None:
        """Take networks that see the same images.

        Args:
            networks: one, or the members of an ensemble.
            samples: draws of MC dropout; 1 and less: no dropout.
            seed: of the draws; the same images give the same belief.
            trained_for: how wrong the guesses were that they learned from; None: not known.

        Raises:
            ConfigError: there are none, or they do not fit together.
        """
        if not networks:
            raise ConfigError('expected at least one network')
        if len({network.settings.images for network in networks}) > 1:
            raise ConfigError('the members of an ensemble must see the same images')
        if len(networks) > 1 and any(n.settings.head != 'quaternion' for n in networks):
            raise ConfigError('an ensemble is made of networks with quaternion heads (thesis: DE)')
        self.networks = [network.eval() for network in networks]
        self.settings = networks[0].settings
        self._samples, self._seed = samples, seed
        self.trained_for = trained_for
        # Of the last shape of features: the seed draws the same every time.
        self._masks: tuple[tuple[torch.Size, torch.device], list[Tensor]] | None = None

    @classmethod
    def load(
        cls, path: Path, device: torch.device | str = 'cpu', samples: int = 30, seed: int = 0
    ) -> 'Predictor':
        """Read a network, or all networks of a folder as an ensemble.

        A folder of train_cmrnet holds one network, its best; a folder of such folders is an
        ensemble of theirs.

        Raises:
            DataError: there are none, or a file holds none.
        """
        loaded = [load_network(file, device) for file in weights_in(path)]
        return cls([one for one, _ in loaded], samples, seed, _trained_for(loaded[0][1]))

    @property
    def kind(self) -> str:
        """What this is: plain, mcd, de, der or covariance."""
        if self.settings.head != 'quaternion':
            return {'evidential': 'der', 'covariance': 'covariance'}[self.settings.head]
        if len(self.networks) > 1:
            return 'de'
        return 'mcd' if self.settings.dropout > 0 and self._samples > 1 else 'plain'

    def with_samples(self, samples: int) -> 'Predictor':
        """Return the same networks with another number of draws."""
        return Predictor(self.networks, samples, self._seed, self.trained_for)

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.networks[0].parameters()).device

    @torch.no_grad()
    def belief(self, image: Tensor, lidar: Tensor) -> PoseBelief:
        """Return what the networks believe of images [B x 3 x H x W] and LiDAR images [B x H x W].

        See `Cmrnet.trunk`. MC dropout uses one pass through the trunk.
        """
        image, lidar = image.to(self.device), lidar.to(self.device)
        if self.kind in ('mcd', 'de'):
            return gaussian_of_samples(self.draws(image, lidar))
        network = self.networks[0]
        output = network.head(network.trunk(image, lidar))
        if isinstance(output, Evidence):
            return _student_t(output)
        if isinstance(output, GaussianPose):
            return _correlated(output)
        mean = means(output)
        nothing = np.zeros_like(mean)
        return PoseBelief(mean, nothing, np.full_like(mean, np.inf), nothing)

    @torch.no_grad()
    def draws(self, image: Tensor, lidar: Tensor) -> Array:
        """Return the components [S x B x 6] of each draw of MC dropout, or of each member.

        Raises:
            ConfigError: this is neither.
        """
        if self.kind not in ('mcd', 'de'):
            raise ConfigError(f'{self.kind} draws nothing: expected MC dropout or an ensemble')
        image, lidar = image.to(self.device), lidar.to(self.device)
        if self.kind == 'de':
            return np.stack([means(network(image, lidar)) for network in self.networks])
        network = self.networks[0]
        return self._dropped(network, network.trunk(image, lidar))

    def _dropped(self, network: Cmrnet, features: Tensor) -> Array:
        """Return sampled components [S x B x 6] of features [B x F]."""
        count, batch = self._samples, len(features)
        repeated = features.repeat(count, 1)
        key = repeated.shape, repeated.device
        if self._masks is None or self._masks[0] != key:
            self._masks = key, self._drawn_masks(network, repeated)
        masks = iter(self._masks[1])
        output = network.head(repeated, lambda x: x * next(masks))
        return means(output).reshape(count, batch, 6)

    def _drawn_masks(self, network: Cmrnet, features: Tensor) -> list[Tensor]:
        """Return what dropout multiplies with, layer by layer, when it draws with the seed."""
        masks: list[Tensor] = []

        def drop(x: Tensor) -> Tensor:
            masks.append(functional.dropout(torch.ones_like(x), self.settings.dropout))
            return x * masks[-1]

        devices = [features.device] if features.device.type == 'cuda' else []
        with torch.random.fork_rng(devices=devices):
            torch.manual_seed(self._seed)
            network.head(features, drop)
        return masks


def weights_in(path: Path) -> list[Path]:
    """Return the files of weights that a path names; see `Predictor.load`.

    Raises:
        DataError: there are none.
    """
    files = [path]
    if path.is_dir():
        # What a training goes on from is no network of its own.
        files = sorted(f for f in path.glob('*.safetensors') if f.name != 'checkpoint.safetensors')
        files = files or sorted(path.glob('*/best.safetensors'))
    if not files or not files[0].is_file():
        raise DataError(f'{path}: expected a .safetensors file or a folder of them, found none')
    return files


def _trained_for(facts: Mapping[str, Any]) -> NoiseRange | None:
    """Return the widest range of guesses that the facts of a file of weights name."""
    ranges = [NoiseRange(float(m), float(np.deg2rad(d))) for m, d in facts.get('guesses_m_deg', ())]
    return max(ranges, key=lambda one: one.translation_m, default=None)


def means(output: Output) -> Array:
    """Return the components [B x 6] that an output holds for the likeliest."""
    if isinstance(output, QuaternionPose):
        angles = euler.euler_of_quaternion(output.quaternion)
        mean = torch.cat([output.translation, angles], 1)
    elif isinstance(output, Evidence):
        mean = output.gamma
    else:
        mean = output.mean
    return mean.detach().double().cpu().numpy()


def _student_t(evidence: Evidence) -> PoseBelief:
    scale, freedom, epistemic = (
        values.detach().double().cpu().numpy()
        for values in (
            evidence.squared_scale.sqrt(),
            evidence.degrees_of_freedom,
            evidence.epistemic_variance,
        )
    )
    return PoseBelief(means(evidence), scale, freedom, epistemic)


def _correlated(pose: GaussianPose) -> PoseBelief:
    root = pose.information_root.detach().double().cpu().numpy()
    covariance = np.linalg.inv(root @ np.swapaxes(root, 1, 2))
    scale = np.sqrt(np.einsum('nii->ni', covariance))
    correlation = covariance / (scale[:, :, None] * scale[:, None, :])
    nothing = np.zeros_like(scale)
    return PoseBelief(means(pose), scale, np.full_like(scale, np.inf), nothing, correlation)
