"""How bright surfaces are in near infrared, as a car's LiDAR sees them.

Set so that the medians of KITTI's remission by SemanticKITTI's labels (road 0.24, terrain 0.35,
building 0.36, vegetation 0.34, pole 0.26, car 0.04: clear coat mirrors the beam away) come out for
four scans of sequence 00.
"""

from typing import Any

import numpy as np

from bags.street.mesh import Label, Material

_MATERIAL = {
    Material.ASPHALT: 0.36,
    Material.GRASS: 0.52,
    Material.PLASTER: 0.50,
    Material.BRICK: 0.38,
    Material.GLASS: 0.10,
    Material.METAL: 0.32,
    Material.LEAF: 0.44,
    Material.BARK: 0.32,
    Material.WOOD: 0.38,
}
_CLEAR_COAT = 0.2
_PATCH_M = 2.0

# By label and material: REFLECTIVITY[label, material].
REFLECTIVITY = np.tile([_MATERIAL[material] for material in Material], (256, 1)).astype(np.float32)
REFLECTIVITY[[Label.CAR, Label.MOVING_CAR, Label.TRUCK]] *= _CLEAR_COAT


def patchiness(xyz: Any, xp: Any = np) -> Any:
    """Return factors 0.7..1.3 [...] on the reflectivity at world points [... x 3], by 2 m cells.

    `xp` is numpy or torch, whichever the points are of.
    """
    x, y, z = (xp.asarray(xp.floor(xyz[..., k] / _PATCH_M), dtype=xp.int32) for k in range(3))
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    mixed = mixed ^ (mixed >> 13)
    return 0.7 + 0.6 * (xp.asarray(mixed & 0xFFFF, dtype=xp.float32) / 65535.0)
