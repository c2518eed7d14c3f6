"""What all networks share: from submaps to an embedding, with dropout and a variance if asked."""

from typing import Any, NamedTuple

from torch import Tensor, nn
from torch.nn import functional


class Embedding(NamedTuple):
    """Embeddings of a batch.

    Attributes:
        mean: [B x D].
        variance: [B x D] of an aleatoric head, 0..1; None where the network has none.
    """

    mean: Tensor
    variance: Tensor | None


class PlaceNetwork(nn.Module):
    """Embed submaps in two steps, so that networks of one shape share the first.

    `prepare` depends on the points and the shape alone, never on weights: voxels with their kernel
    maps, or an image. Calling the network on what was prepared gives the embedding.

    Attributes:
        settings: its shape, a frozen config with `size`, `dropout`, `variance` and `unit_length`.
    """

    def __init__(self, settings: Any) -> None:
        super().__init__()
        self.settings = settings
        # Where Mason et al. put it: on local features, just before they are pooled.
        self.dropout = nn.Dropout(settings.dropout)
        self.variance = nn.Linear(settings.size, settings.size) if settings.variance else None

    def prepare(self, points: Tensor) -> Any:
        """Return what the network sees of submaps [B x P x 3]."""
        raise NotImplementedError

    def pool(self, seen: Any) -> Tensor:
        """Return pooled features [B x D] of what was prepared."""
        raise NotImplementedError

    def forward(self, seen: Any) -> Embedding:
        """Return embeddings of what was prepared."""
        pooled = self.pool(seen)
        # STUN's head (Cai et al., IROS 2022) as Mason et al. have it: linear, then a sigmoid.
        variance = None if self.variance is None else self.variance(pooled).sigmoid()
        mean = functional.normalize(pooled, dim=1) if self.settings.unit_length else pooled
        return Embedding(mean, variance)

    def embed(self, points: Tensor) -> Tensor:
        """Return embeddings [B x D] of submaps [B x P x 3]."""
        embedding: Embedding = self(self.prepare(points))
        return embedding.mean
