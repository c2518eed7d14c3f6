"""Draw batches of places for training."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lcd_common import se3
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig, augmented
from lcd_loop_closure.lcdnet.places import PlaceShard
from lcd_loop_closure.lcdnet.voxels import Clouds


@dataclass(frozen=True)
class Batch:
    """Clouds of several places and what is true of them.

    Attributes:
        clouds: B of them, place after place.
        source, target: [P] pairs of clouds of one place; the first half are loops.
        T_target_source: [P x 4 x 4] float32.
        loops: how many of the pairs are loops (near enough for one place).
        different: [B x B] bool, whether two clouds show different places.
    """

    clouds: Clouds
    source: Tensor
    target: Tensor
    T_target_source: Tensor
    loops: int
    different: Tensor

    def to(self, device: torch.device) -> 'Batch':
        """Return the batch on a device."""
        c = self.clouds
        clouds = Clouds(c.xyz.to(device), c.intensity.to(device), c.batch.to(device), c.size)
        return Batch(
            clouds,
            self.source.to(device),
            self.target.to(device),
            self.T_target_source.to(device),
            self.loops,
            self.different.to(device),
        )


def draw_batch(
    shards: Sequence[PlaceShard],
    places: int,
    settings: AugmentationConfig,
    rng: np.random.Generator,
    *,
    different_m: float = 10.0,
) -> Batch:
    """Return the augmented sweeps of places drawn at random.

    Each place brings its first sweep, one of the same spot, and one a little farther away. Pairs
    are (first, second) of all places, which are loops, then (first, third).

    Args:
        shards: to draw from.
        places: how many.
        settings: of the augmentation.
        rng: of everything.
        different_m: clouds farther apart than this show different places.
    """
    sweeps, true_poses, towns = [], [], []
    for _ in range(places):
        shard = shards[int(rng.integers(len(shards)))]
        place = shard.place(int(rng.integers(len(shard))))
        blind = rng.random() < settings.no_intensity_share
        for sweep in place.sweeps:
            one = augmented(sweep, settings, rng)
            intensity = torch.zeros(len(one.xyz)) if blind else torch.from_numpy(one.intensity)
            sweeps.append((torch.from_numpy(one.xyz), intensity, one.T_new_base))
            true_poses.append(sweep.T_world_base)
            towns.append(place.town)
    per = len(sweeps) // places
    first = np.arange(places) * per
    source = np.concatenate([first] * (per - 1))
    target = np.concatenate([first + k for k in range(1, per)])
    T_pairs = []
    for i, j in zip(source, target, strict=True):
        T = sweeps[j][2] @ se3.inverse(true_poses[j]) @ true_poses[i] @ se3.inverse(sweeps[i][2])
        T_pairs.append(T)
    at = np.array(true_poses)[:, :3, 3]
    apart = np.linalg.norm(at[:, None] - at[None], axis=2) > different_m
    apart |= np.array(towns)[:, None] != np.array(towns)[None]
    return Batch(
        Clouds.of([s[0] for s in sweeps], [s[1] for s in sweeps]),
        torch.from_numpy(source),
        torch.from_numpy(target),
        torch.from_numpy(np.array(T_pairs, np.float32)),
        places,
        torch.from_numpy(apart),
    )
