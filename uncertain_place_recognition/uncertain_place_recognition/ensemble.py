"""Embed a submap with every member of an ensemble; what does not depend on weights is done once."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lcd_common.errors import ConfigError, DataError
from uncertain_place_recognition.networks.embedding import Embedding, PlaceNetwork
from uncertain_place_recognition.networks.weights import load_networks, save_networks
from uncertain_place_recognition.submap import SubmapConfig

PACKED = 'ensemble.safetensors'
BEST = 'best.safetensors'


class EmbeddingEnsemble:
    """Members of one shape; a single one with dropout stands for as many passes as are asked for.

    Attributes:
        settings: shape of the networks.
        facts: what the file tells: kind, how it was trained.
    """

    def __init__(
        self,
        members: Sequence[PlaceNetwork],
        facts: dict[str, Any] | None = None,
        *,
        device: torch.device | str = 'cpu',
        passes: int = 5,
    ) -> None:
        """Take members.

        Args:
            members: of one shape.
            facts: to keep beside them.
            device: to run on.
            passes: of Monte Carlo dropout, where a single member has dropout.

        Raises:
            ConfigError: there is none, or their shapes differ.
        """
        if not members or any(one.settings != members[0].settings for one in members):
            raise ConfigError(
                f'an ensemble needs members of one shape, got {len(members)} members of '
                f'{len({one.settings for one in members})} shapes'
            )
        self.members = [one.to(device).eval() for one in members]
        self.settings, self.facts = members[0].settings, dict(facts or {})
        self.device = torch.device(device)
        self._drops = len(members) == 1 and self.settings.dropout > 0.0
        self.size = passes if self._drops else len(members)
        for module in self.members[0].modules() if self._drops else ():
            if isinstance(module, nn.Dropout):
                module.train()

    @classmethod
    def load(
        cls, path: Path, device: torch.device | str = 'cpu', passes: int = 5
    ) -> 'EmbeddingEnsemble':
        """Read a file of weights, or a folder's ensemble.safetensors or best.safetensors.

        Raises:
            DataError: there is no such file, or its weights do not fit.
        """
        if path.is_dir():
            found = [path / name for name in (PACKED, BEST) if (path / name).is_file()]
            if not found:
                raise DataError(f'{path}: expected {PACKED} or {BEST} in it; train one first')
            path = found[0]
        return cls(*load_networks(path, device), device=device, passes=passes)

    def save(self, path: Path, *, half: bool = True) -> None:
        """Write all members into one file."""
        save_networks(path, self.members, self.facts, half=half)

    @property
    def length(self) -> int:
        """D: numbers of an embedding."""
        return int(self.settings.size)

    @property
    def submap(self) -> SubmapConfig:
        """How the submaps were made that the members were trained on.

        Raises:
            ConfigError: they are the benchmark's, which no live sweep is like.
        """
        if self.facts.get('normalisation') == 'benchmark':
            raise ConfigError(
                'these weights know the submaps of the PointNetVLAD benchmark alone, which have no '
                'metric scale; live sweeps need weights trained on metric submaps'
            )
        return SubmapConfig(**self.facts.get('submap', {}))

    def embed(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return one embedding from each member [M x D] of a submap [P x 3].

        Raises:
            DataError: the submap has another shape, or a coordinate is no number.
        """
        return self.embed_many(points[None])[0]

    def embed_many(self, points: NDArray[Any]) -> NDArray[np.float32]:
        """Return embeddings [B x M x D] of submaps [B x P x 3]."""
        return self._run(points).mean.transpose(0, 1).cpu().numpy()

    def embed_with_variance(
        self, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Return embeddings [M x D] and what an aleatoric head thinks of their variances [M x D].

        The second is None where the members have no such head.
        """
        found = self._run(points[None])
        variance = None if found.variance is None else found.variance[:, 0].cpu().numpy()
        return found.mean[:, 0].cpu().numpy(), variance

    def _run(self, points: NDArray[Any]) -> Embedding:
        if points.ndim != 3 or points.shape[2] != 3 or not points.shape[1]:
            raise DataError(f'a submap has the shape P x 3, got {points.shape[1:]}')
        if not np.isfinite(points).all():
            raise DataError('a submap holds no NaN or infinite coordinates; drop such points first')
        with torch.inference_mode():
            given = torch.from_numpy(np.asarray(points, np.float32)).to(self.device)
            seen = self.members[0].prepare(given)
            # One after another: batching them over stacked weights was measured to be no faster.
            if not self._drops:
                return _joined([member(seen) for member in self.members])
            # The same submap meets the same masks, so that the same question has one answer.
            with torch.random.fork_rng([self.device] if self.device.type == 'cuda' else []):
                torch.manual_seed(0)
                return _joined([self.members[0](seen) for _ in range(self.size)])


def _joined(found: Sequence[Embedding]) -> Embedding:
    """Stack embeddings of members to [M x B x D]."""
    variances = [one.variance for one in found if one.variance is not None]
    return Embedding(
        torch.stack([one.mean for one in found]), torch.stack(variances) if variances else None
    )
