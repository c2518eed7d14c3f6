"""Tell by distance which submaps show the same place, over any runs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from uncertain_place_recognition.runs import SubmapRun

_SAME_M = 1e-3


@config
class PairConfig:
    """Which pairs teach what (Uy and Lee, CVPR 2018); what lies between the radii teaches nothing.

    Smaller submaps want smaller radii.
    """

    positive: float = setting(10.0, 'submaps at most so far apart show one place', unit='m', low=0)
    negative: float = setting(50.0, 'those farther apart show different ones', unit='m', low=0)
    gap: float = setting(
        20.0,
        'submaps of one run at least so far apart in time are of another pass',
        unit='s',
        low=0,
    )
    other_pass: float = setting(
        0.7, 'share of the pairs taken from another pass or run, where there is one', low=0, high=1
    )

    def check(self) -> 'PairConfig':
        """Return this configuration; raises DataError when the radii are the wrong way round."""
        if self.negative < self.positive:
            raise DataError(
                f'negatives must lie farther away than positives, got {self.negative:g} m and '
                f'{self.positive:g} m'
            )
        return self


@dataclass(frozen=True)
class Relations:
    """Which submaps of a batch belong together; symmetric [B x B] masks, false on the diagonal."""

    positive: NDArray[np.bool_]
    negative: NDArray[np.bool_]


class PlacePairs:
    """Submaps of all runs, numbered through, and what lies near what.

    Runs of one world are compared; submaps of different worlds are always different places. A
    submap is no pair with itself, nor with a copy of itself in another run.

    Attributes:
        run: [N] the run of each submap; `at` [N] its number there.
        anchors: submaps that have a positive.
    """

    def __init__(self, runs: Sequence[SubmapRun], settings: PairConfig | None = None) -> None:
        """Find the pairs.

        Raises:
            DataError: no two submaps show one place.
        """
        self.settings = (settings or PairConfig()).check()
        worlds = {name: k for k, name in enumerate(sorted({run.world for run in runs}))}
        self.run = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        self.at = np.concatenate([np.arange(len(run)) for run in runs] or [np.empty(0, np.intp)])
        self._world = np.repeat([worlds[r.world] for r in runs], [len(r) for r in runs])
        self._xy = np.concatenate([run.positions for run in runs] or [np.empty((0, 2))])
        self._stamp = np.concatenate([run.stamps_ns for run in runs] or [np.empty(0, np.int64)])
        self._near: list[NDArray[np.intp]] = [np.empty(0, np.intp)] * len(self.run)
        for world in range(len(worlds)):
            self._look(np.flatnonzero(self._world == world))
        self.anchors = np.flatnonzero([len(near) > 0 for near in self._near])
        if not len(self.anchors):
            raise DataError(
                f'no two of {len(self.run)} submaps lie within {self.settings.positive:g} m: '
                'check the poses, or raise the radius of positives'
            )

    def __len__(self) -> int:
        return len(self.run)

    def positives(self, submap: int) -> NDArray[np.intp]:
        """Return the submaps [K] that show the place of one."""
        return self._near[submap]

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
        """Return `count` pairs [2 count]: an anchor, its positive, the next anchor, ..."""
        anchors = rng.choice(self.anchors, count, replace=count > len(self.anchors))
        chosen = np.empty(2 * count, np.intp)
        for k, anchor in enumerate(anchors.tolist()):
            near = self._near[anchor]
            other = near[self._is_other_pass(anchor, near)]
            if len(other) and rng.random() < self.settings.other_pass:
                near = other
            chosen[2 * k : 2 * k + 2] = anchor, near[int(rng.integers(len(near)))]
        return chosen

    def relations(self, chosen: NDArray[np.intp]) -> Relations:
        """Return which of the chosen submaps [B] show one place and which show different ones."""
        xy, world = self._xy[chosen], self._world[chosen]
        distance = np.linalg.norm(xy[:, None] - xy, axis=2)
        together = world[:, None] == world
        copies = (distance < _SAME_M) & (self._stamp[chosen][:, None] == self._stamp[chosen])
        positive = together & (distance <= self.settings.positive) & ~copies
        # The same submap may have been drawn twice.
        positive &= chosen[:, None] != chosen
        negative = ~together | (distance > self.settings.negative)
        return Relations(positive, negative)

    def _look(self, members: NDArray[np.intp]) -> None:
        tree = cKDTree(self._xy[members])
        found = tree.query_ball_point(self._xy[members], self.settings.positive)
        for submap, near in zip(members.tolist(), found, strict=True):
            others = members[np.sort(np.asarray(near, np.intp))]
            copy = self._stamp[others] == self._stamp[submap]
            copy &= np.linalg.norm(self._xy[others] - self._xy[submap], axis=1) < _SAME_M
            self._near[submap] = others[~copy]

    def _is_other_pass(self, submap: int, others: NDArray[np.intp]) -> NDArray[np.bool_]:
        apart = np.abs(self._stamp[others] - self._stamp[submap])
        return (self.run[others] != self.run[submap]) | (apart > self.settings.gap * 1e9)
