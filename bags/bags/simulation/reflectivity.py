"""How bright surfaces are in near infrared, as a car's LiDAR sees them.

Set so that the medians of KITTI's remission by SemanticKITTI's labels (road 0.24, terrain 0.35,
building 0.36, vegetation 0.34, pole 0.26, car 0.04: clear coat mirrors the beam away) come out for
four scans of sequence 00.
"""

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

# By label and material: REFLECTIVITY[label, material].
REFLECTIVITY = np.tile([_MATERIAL[material] for material in Material], (256, 1)).astype(np.float32)
REFLECTIVITY[[Label.CAR, Label.MOVING_CAR, Label.TRUCK]] *= _CLEAR_COAT
