"""What the rays of a sensor hit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Hits:
    """The nearest surface along each ray; whoever casts the rays gives the same answer.

    Attributes:
        range_m: [N] along the unit ray; infinity where it hits nothing.
        incidence: [N] cosine of the angle to the normal, 0..1.
        triangle: [N] of the scene's mesh, -1 where the ray hits nothing or a mover.
        material: [N] bags.street.mesh.Material.
        label: [N] bags.street.mesh.Label.
        mover: [N] index of the scene's mover, -1 otherwise.
    """

    range_m: NDArray[np.float32]
    incidence: NDArray[np.float32]
    triangle: NDArray[np.int32]
    material: NDArray[np.uint8]
    label: NDArray[np.uint8]
    mover: NDArray[np.int16]
