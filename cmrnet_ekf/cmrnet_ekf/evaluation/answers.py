"""Ask a method about samples, once, and keep what it said."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cmrnet_ekf import euler
from cmrnet_ekf.localization_errors import LocalizationErrors, pose_errors, summary
from cmrnet_ekf.pose_belief import PoseBelief, gaussian_of_samples, joined
from cmrnet_ekf.pose_sampling import targets
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.validation import batches
from lcd_common.errors import ConfigError
from lcd_common.se3 import Array


@dataclass(frozen=True)
class Answers:
    """What a method believes of N samples, and what is true.

    Attributes:
        kind: of the predictor.
        belief: of T_guess_camera.
        target: [N x 6] its components.
        draws: [S x N x 6] of MC dropout or of members; None of others. There may be more than the
            belief is made of.
    """

    kind: str
    belief: PoseBelief
    target: Array
    draws: Array | None = None

    @cached_property
    def errors(self) -> tuple[Array, Array]:
        """Distances, metres, and angles, radians, to the truth [N]."""
        return pose_errors(euler.transforms(self.target), self.belief.transforms)

    @property
    def knows(self) -> bool:
        """Whether it says how sure it is."""
        return bool((self.belief.scale > 0).all())

    def summary(self, which: 'slice | np.ndarray' = slice(None)) -> LocalizationErrors:
        """Return the errors of some or all samples."""
        metres, radians = self.errors
        return summary(metres[which], radians[which])

    def drawn(self, which: Sequence[int] | slice) -> 'Answers':
        """Return what some of the draws alone would say."""
        assert self.draws is not None
        return Answers(self.kind, gaussian_of_samples(self.draws[which].copy()), self.target)


def ask(
    predictor: Predictor,
    sets: Sequence[SampleSet],
    per_set: int | None = None,
    used: int = 30,
    progress: Callable[[int], object] = lambda count: None,
) -> Answers:
    """Return what a predictor says of samples.

    Args:
        predictor: to ask.
        sets: of samples.
        per_set: evenly chosen from each set; None: all.
        used: draws of MC dropout that the belief is made of.
        progress: called with how many samples were asked.

    Raises:
        ConfigError: the network takes other images than the samples are.
    """
    for one in sets:
        if one.images != tuple(predictor.settings.images):
            raise ConfigError(
                f'{one.path}: samples of images {one.images}, the network takes '
                f'{tuple(predictor.settings.images)}; make samples for this network'
            )
    draws_ = predictor.kind in ('mcd', 'de')
    beliefs: list[PoseBelief] = []
    draws: list[Array] = []
    guesses: list[Array] = []
    for one, index in batches(sets, per_set):
        batch = one.batch(index)
        guesses.append(np.asarray(one.guesses[index]))
        if draws_:
            draws.append(predictor.draws(batch.image, batch.lidar))
        else:
            beliefs.append(predictor.belief(batch.image, batch.lidar))
        progress(len(index))
    target = targets(np.concatenate(guesses))
    if not draws_:
        return Answers(predictor.kind, joined(beliefs), target)
    every = np.concatenate(draws, axis=1)
    first = every[:used] if predictor.kind == 'mcd' else every
    return Answers(predictor.kind, gaussian_of_samples(first.copy()), target, every)
