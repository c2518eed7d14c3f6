"""Let several networks teach together: their mean embedding recognises more than each of them."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lcd_common.errors import ConfigError
from uncertain_place_recognition.networks.embedding import Embedding, PlaceNetwork


class MeanTeacher(PlaceNetwork):
    """The mean of embeddings of networks of one shape.

    Members trained from scratch have a space each, but their mean is a space as good as any: what
    is alike for all of them stays alike. Students then share that one space, as in equation 21.
    """

    def __init__(self, members: Sequence[PlaceNetwork]) -> None:
        """Take the members.

        Raises:
            ConfigError: there is none, or their shapes differ.
        """
        if not members or any(one.settings != members[0].settings for one in members):
            raise ConfigError(
                f'teachers must have one shape, got {len(members)} networks of '
                f'{len({one.settings for one in members})} shapes'
            )
        super().__init__(members[0].settings)
        self.members = nn.ModuleList(members)

    def prepare(self, points: Tensor) -> Any:
        """Return what every member sees of submaps [B x P x 3]."""
        first: Any = self.members[0]
        return first.prepare(points)

    def forward(self, seen: Any) -> Embedding:
        """Return the mean embeddings [B x D] of what was prepared."""
        found = [member(seen).mean for member in self.members]
        return Embedding(torch.stack(found).mean(0), None)
