"""Change sweeps at random so that features do not depend on what must not matter (3.3.2)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.places import PlaceSweep


@config
class AugmentationConfig:
    """What is drawn for each sweep; motions are the thesis's."""

    yaw: float = setting(180.0, 'largest turn to either side', unit='deg', low=0.0, high=180.0)
    tilt: float = setting(3.0, 'largest roll and pitch', unit='deg', low=0.0)
    shift: float = setting(1.5, 'largest shift along x and y', unit='m', low=0.0)
    lift: float = setting(0.25, 'largest shift along z', unit='m', low=0.0)
    blocked_share: float = setting(0.3, 'share of sweeps with a blocked sector', low=0.0, high=1.0)
    blocked_most: float = setting(120.0, 'widest blocked sector', unit='deg', low=0.0, high=360.0)
    thinned_share: float = setting(
        0.5, 'share of sweeps that lose points at random', low=0.0, high=1.0
    )
    thinned_most: float = setting(0.7, 'largest share of points lost', low=0.0, high=1.0)
    near_share: float = setting(
        0.2, 'share of sweeps that end earlier than the network sees', low=0.0, high=1.0
    )
    near_least: float = setting(25.0, 'where they end at the earliest', unit='m', low=5.0)
    no_intensity_share: float = setting(
        0.5, 'share of places seen by a sensor without intensity', low=0.0, high=1.0
    )


@dataclass(frozen=True)
class AugmentedSweep:
    """A changed sweep; T_new_base takes points of the sweep as it was to where they are now."""

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    T_new_base: se3.Array


def augmented(
    sweep: PlaceSweep, settings: AugmentationConfig, rng: np.random.Generator
) -> AugmentedSweep:
    """Return a sweep turned, shifted, thinned and partly blocked at random."""
    s = settings
    angles = [
        rng.uniform(-s.yaw, s.yaw),
        rng.uniform(-s.tilt, s.tilt),
        rng.uniform(-s.tilt, s.tilt),
    ]
    shift = [rng.uniform(-s.shift, s.shift), rng.uniform(-s.shift, s.shift)]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('ZYX', angles, degrees=True).as_matrix()
    T[:3, 3] = *shift, rng.uniform(-s.lift, s.lift)
    xyz, intensity = sweep.xyz, sweep.intensity
    keep = np.ones(len(xyz), bool)
    if rng.random() < s.thinned_share:
        keep &= rng.random(len(xyz), np.float32) > rng.uniform(0.0, s.thinned_most)
    if rng.random() < s.near_share:
        keep &= np.hypot(xyz[:, 0], xyz[:, 1]) < rng.uniform(s.near_least, 2.0 * s.near_least)
    if rng.random() < s.blocked_share:
        begin, width = rng.uniform(-180.0, 180.0), rng.uniform(0.0, s.blocked_most)
        keep &= (np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) - begin) % 360.0 > width
    moved = xyz[keep] @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    return AugmentedSweep(moved, intensity[keep], T)
