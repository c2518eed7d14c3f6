"""Hold what a step of training sees."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """What a step of training sees.

    Attributes:
        image, lidar: see `Cmrnet.trunk`.
        target: [B x 6] components of T_guess_camera.
        camera: [B x 4] fx fy cx cy, pixels; NaN where they are not known.
    """

    image: Tensor
    lidar: Tensor
    target: Tensor
    camera: Tensor

    def to(self, device: torch.device) -> 'Batch':
        """Return the batch on a device."""
        parts = (self.image, self.lidar, self.target, self.camera)
        return Batch(*(part.to(device) for part in parts))
