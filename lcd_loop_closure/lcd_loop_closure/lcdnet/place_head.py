"""Train the place head alone, on features that are computed once: large batches cost little then.

A batch of the whole network holds few places on a CPU, and few negatives teach little. With the
backbone at rest, many sweeps fit in a batch; they come in groups of neighbours, because what a
drive must tell apart are the spots of one street.
"""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting
from lcd_loop_closure.evaluation.detection_protocols import (
    PrecisionRecall,
    candidates,
    protocol_1,
)
from lcd_loop_closure.lcdnet.losses import separation_loss
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.place_features import PlaceFeatures
from lcd_loop_closure.revisits import RevisitConfig


@config
class PlaceHeadConfig:
    """How the place head is trained on its own."""

    steps: int = setting(700, 'batches', low=1)
    groups: int = setting(14, 'neighbourhoods of a batch', low=1)
    sweeps: int = setting(16, 'sweeps of a neighbourhood', low=2)
    around: float = setting(20.0, 'how far its sweeps lie from its middle', unit='m', low=4.0)
    keypoints: int = setting(512, 'drawn anew of each sweep in each batch', low=16)
    sector: float = setting(
        60.0, 'greatest sector left out of a sweep, drawn anew', unit='deg', low=0.0, high=180.0
    )
    same: float = setting(4.0, 'sweeps up to this far apart show one place', unit='m', low=0.1)
    farther: float = setting(
        1.5, 'a sweep farther away by so much must be less alike', unit='m', low=0.1
    )
    returned: float = setting(
        50.0, 'way between two sweeps that show a return to a place', unit='m', low=0.0
    )
    temperature: float = setting(0.05, 'of the similarities in the loss', low=1e-3)
    learning_rate: float = setting(0.001, "Adam's, at the start; falls to a hundredth", low=1e-7)
    weight_decay: float = setting(5e-6, "Adam's", low=0.0)
    seed: int = setting(0, 'of everything drawn', low=0)


def train_place_head(
    network: Lcdnet, features: PlaceFeatures, settings: PlaceHeadConfig
) -> Iterator[tuple[int, float, float]]:
    """Train the place head; yield step, loss and the share of loops less alike than a negative."""
    s, head = settings, network.place
    device = next(head.parameters()).device
    optimizer = torch.optim.Adam(head.parameters(), s.learning_rate, weight_decay=s.weight_decay)
    middles = Neighbourhoods(features, s)
    head.train()
    for step in range(s.steps):
        rng = np.random.default_rng([s.seed, step, 101])
        chosen = middles.draw(rng)
        values, keypoints = _some_keypoints(features, chosen, s, rng)
        descriptors = network.describe(values.to(device), keypoints.to(device))
        same, away = middles.relations(chosen)
        loss, confused = separation_loss(
            descriptors,
            torch.from_numpy(same).to(device),
            torch.from_numpy(away).to(device),
            s.temperature,
            s.farther,
        )
        for group in optimizer.param_groups:
            group['lr'] = s.learning_rate * (0.505 + 0.495 * np.cos(np.pi * step / s.steps))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        yield step + 1, float(loss.detach()), confused
    head.eval()


def _some_keypoints(
    features: PlaceFeatures, rows: NDArray[np.intp], s: PlaceHeadConfig, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return features [B x N x D] and positions of some keypoints of each sweep.

    A sector of its own is left out of each sweep, which costs nothing here.
    """
    chosen = torch.from_numpy(rows)
    at = features.keypoints[chosen].float()
    bearing = torch.atan2(at[..., 1], at[..., 0]).numpy()
    middle = rng.uniform(-np.pi, np.pi, (len(rows), 1))
    off = np.abs((bearing - middle + np.pi) % (2.0 * np.pi) - np.pi)
    hidden = off < np.radians(s.sector) / 2.0 * rng.random((len(rows), 1))
    order = (rng.random(hidden.shape) + hidden).argsort(1)[:, : s.keypoints, None]
    picked = [
        torch.gather(
            whole[chosen], 1, torch.from_numpy(order).expand(-1, -1, whole.shape[2])
        ).float()
        for whole in (features.values, features.keypoints)
    ]
    return picked[0], picked[1]


class Neighbourhoods:
    """Draw sweeps around spots that a drive returned to."""

    def __init__(self, features: PlaceFeatures, settings: PlaceHeadConfig) -> None:
        """Look for the spots.

        Raises:
            ConfigError: no drive returns to a place.
        """
        self._settings = settings
        self._position = features.position.numpy()
        self._town, self._path_m = features.town.numpy(), features.path_m.numpy()
        self._rows = {int(t): np.flatnonzero(self._town == t) for t in np.unique(self._town)}
        loops = [rows[self._same(rows, rows).any(1)] for rows in self._rows.values()]
        self._loops = np.concatenate(loops)
        if not len(self._loops):
            raise ConfigError('none of the drives returns to a place: nothing can be learnt')

    def draw(self, rng: np.random.Generator) -> NDArray[np.intp]:
        """Return the rows of a batch: each neighbourhood has a loop at least."""
        s, groups = self._settings, []
        for middle in rng.choice(self._loops, s.groups):
            rows = self._rows[int(self._town[middle])]
            partners = rows[self._same(np.array([middle]), rows)[0]]
            away = np.linalg.norm(self._position[rows] - self._position[middle], axis=1)
            near = rows[away <= s.around]
            others = rng.choice(near, min(s.sweeps - 2, len(near)), replace=False)
            groups.append([middle, rng.choice(partners), *others])
        return np.unique(np.concatenate(groups)).astype(np.intp)

    def relations(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return which of the sweeps [B x B] are returns to one place, and how far apart all are.

        Sweeps of different towns are infinitely far apart; sweeps of one pass (less way apart than
        a return) are NaN: a drive never asks for its latest sweeps.
        """
        away = self._away(rows, rows)
        return away <= self._settings.same, away

    def _same(self, a: NDArray[np.intp], b: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return whether rows a are returns to the places of rows b [A x B]."""
        return self._away(a, b) <= self._settings.same

    def _away(self, a: NDArray[np.intp], b: NDArray[np.intp]) -> NDArray[np.float64]:
        away = np.linalg.norm(self._position[a][:, None] - self._position[b], axis=2)
        path = np.abs(self._path_m[a][:, None] - self._path_m[b])
        away[path <= self._settings.returned] = np.nan
        away[self._town[a][:, None] != self._town[b]] = np.inf
        return np.asarray(away)


@torch.inference_mode()
def judge_place_head(
    network: Lcdnet,
    features: PlaceFeatures,
    first: int | None = None,
    hidden: PlaceHeadConfig | None = None,
) -> PrecisionRecall:
    """Return precision and recall by protocol 1 on one drive, its features not augmented.

    Of a drive with a sweep each three metres the latest 17 are left out, the 50 metres that 50
    scans of a sweep each metre are.

    Args:
        network: to judge.
        features: of the drive.
        first: sweep from which on places are asked for: where a second run begins; None: as soon
            as there is a past.
        hidden: leaves out a sector of each sweep and some keypoints, as in training; None: all is
            seen.
    """
    head = network.place.eval()
    device = next(head.parameters()).device
    rng, parts = np.random.default_rng(97), []
    for rows in torch.arange(len(features)).split(32):
        if hidden is None:
            values, at = features.values[rows].float(), features.keypoints[rows].float()
        else:
            values, at = _some_keypoints(features, rows.numpy(), hidden, rng)
        parts.append(network.describe(values.to(device), at.to(device)).cpu())
    descriptors = torch.cat(parts).numpy()
    gap = float(np.median(np.diff(features.path_m.numpy())))
    late = max(1, round(50.0 / max(gap, 0.1)))
    found = candidates(
        lambda i, m: np.linalg.norm(descriptors[:m] - descriptors[i], axis=1),
        features.position.numpy(),
        RevisitConfig(excluded_scans=late, first_scan=2 * late if first is None else first),
    )
    return protocol_1(found)
