"""Keep other road users out of the way of the car that records."""

from dataclasses import replace

import numpy as np

from bags.simulation.journey import Journey
from bags.simulation.scene import Mover, Scene

# Centre to centre: cars that meet in a narrow street are about 2.6 m apart.
_CLEARANCE_M = 2.3


def kept_clear(scene: Scene, journey: Journey) -> Scene:
    """Return the scene without the movers that the car would run into."""
    movers = tuple(mover for mover in scene.movers if not _meets(mover, journey))
    return replace(scene, movers=movers)


def _meets(mover: Mover, journey: Journey) -> bool:
    begin, end = max(0.0, mover.time_s[0]), min(journey.duration_s, mover.time_s[-1])
    time_s = np.arange(begin, end, 0.05)
    if not len(time_s):
        return False
    ours = journey.T_world_base(time_s)[:, :2, 3]
    theirs = np.column_stack(
        [np.interp(time_s, mover.time_s, mover.T_world_mover[:, k, 3]) for k in (0, 1)]
    )
    return bool((np.linalg.norm(ours - theirs, axis=1) < _CLEARANCE_M).any())
