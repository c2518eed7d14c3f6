"""Train the place head alone, on features that are computed once: large batches cost little then.

A batch of the whole network holds few places on a CPU, and few negatives teach little. With the
backbone at rest, hundreds of sweeps fit in a batch.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig, augmented
from lcd_loop_closure.lcdnet.losses import triplet_loss
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import PlaceShard
from lcd_loop_closure.lcdnet.voxels import Clouds


@config
class PlaceHeadConfig:
    """How the place head is trained on its own."""

    steps: int = setting(1500, 'batches', low=1)
    places: int = setting(48, 'places of a batch', low=2)
    learning_rate: float = setting(0.001, "Adam's, at the start; falls to a hundredth", low=1e-7)
    weight_decay: float = setting(5e-6, "Adam's", low=0.0)
    margin: float = setting(0.5, 'm of the triplet loss; negatives are the hardest', low=0.0)
    different: float = setting(
        10.0, 'sweeps farther apart show different places', unit='m', low=0.1
    )
    seed: int = setting(0, 'of everything drawn', low=0)


@dataclass(frozen=True)
class PlaceFeatures:
    """Keypoint features of places, computed once.

    Attributes:
        values: [P x S x N x D] float16, of S sweeps of each place; the first two are a loop.
        position: [P x S x 3] metres.
        town: [P].
    """

    values: Tensor
    position: NDArray[np.float64]
    town: NDArray[np.int64]


@torch.no_grad()
def place_features(
    network: Lcdnet,
    shards: Sequence[PlaceShard],
    augmentation: AugmentationConfig,
    *,
    seed: int = 0,
    progress: Callable[[], None] = lambda: None,
) -> PlaceFeatures:
    """Return the features of all places of the shards, each sweep augmented once.

    Raises:
        ConfigError: there are no shards.
    """
    if not shards:
        raise ConfigError('expected the places of at least one town')
    network.eval()
    device = next(network.parameters()).device
    rng = np.random.default_rng([seed, 97])
    values, position, towns = [], [], []
    for shard in shards:
        for number in range(len(shard)):
            place = shard.place(number)
            blind = rng.random() < augmentation.no_intensity_share
            sweeps = [augmented(sweep, augmentation, rng) for sweep in place.sweeps]
            clouds = Clouds.of(
                [torch.from_numpy(one.xyz).to(device) for one in sweeps],
                [None if blind else torch.from_numpy(one.intensity).to(device) for one in sweeps],
            )
            values.append(network(clouds).features.half().cpu())
            position.append([sweep.T_world_base[:3, 3] for sweep in place.sweeps])
            towns.append(place.town)
            progress()
    return PlaceFeatures(torch.stack(values), np.array(position), np.array(towns, np.int64))


def train_place_head(
    network: Lcdnet, features: PlaceFeatures, settings: PlaceHeadConfig
) -> Iterator[tuple[int, float, float]]:
    """Train the place head; yield step, loss and the share of violated triplets."""
    s, head = settings, network.place
    device = next(head.parameters()).device
    optimizer = torch.optim.Adam(head.parameters(), s.learning_rate, weight_decay=s.weight_decay)
    head.train()
    for step in range(s.steps):
        rng = np.random.default_rng([s.seed, step, 101])
        chosen = rng.choice(len(features.town), min(s.places, len(features.town)), replace=False)
        values = features.values[torch.from_numpy(chosen)].to(device).float()
        places, sweeps = values.shape[:2]
        descriptors = head(values.flatten(0, 1))
        at = features.position[chosen].reshape(-1, 3)
        town = np.repeat(features.town[chosen], sweeps)
        apart = np.linalg.norm(at[:, None] - at[None], axis=2) > s.different
        different = torch.from_numpy(apart | (town[:, None] != town[None])).to(device)
        first = torch.arange(places, device=device) * sweeps
        # Either sweep of a loop may be the anchor.
        anchor, positive = torch.cat([first, first + 1]), torch.cat([first + 1, first])
        loss, violated = triplet_loss(
            descriptors, anchor, positive, different, s.margin, hardest=True
        )
        for group in optimizer.param_groups:
            group['lr'] = s.learning_rate * (0.505 + 0.495 * np.cos(np.pi * step / s.steps))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        yield step + 1, float(loss.detach()), violated
    head.eval()
