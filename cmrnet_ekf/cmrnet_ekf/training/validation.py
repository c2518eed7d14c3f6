"""Judge a network on samples that it was not trained on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf import euler
from cmrnet_ekf.calibration import ause, calibration, sharpness
from cmrnet_ekf.localization_errors import LocalizationErrors, pose_errors, summary
from cmrnet_ekf.pose_belief import PoseBelief, joined
from cmrnet_ekf.pose_sampling import targets
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_set import SampleSet
from lcd_common.se3 import Array

_DEGREES_PER_METRE = 5.0  # about how the errors of the guesses are to each other


@dataclass(frozen=True)
class Validation:
    """How well a predictor does; calibration is empty for one that does not know.

    Attributes:
        rough: errors of the guesses.
        errors: of the predictions.
        calibration: mean calibration error of each component.
        sharpness: root mean variance of each component, m and rad.
        ause_translation: how badly the variances order the errors; 0 is perfectly.
    """

    rough: LocalizationErrors
    errors: LocalizationErrors
    calibration: dict[str, float]
    sharpness: list[float]
    ause_translation: float | None

    @property
    def score(self) -> float:
        """Higher is better: what the best checkpoint is chosen by."""
        return -(self.errors.t_median_m + self.errors.r_median_deg / _DEGREES_PER_METRE)


def predictions(
    predictor: Predictor, sets: Sequence[SampleSet], per_set: int | None = None, batch: int = 16
) -> tuple[PoseBelief, Array, Array]:
    """Return beliefs, targets [N x 6] and guesses [N x 4 x 4] of samples.

    Args:
        predictor: to ask.
        sets: of samples.
        per_set: evenly chosen from each set; None: all.
        batch: asked at a time.
    """
    beliefs, guesses = [], []
    for one, index in batches(sets, per_set, batch):
        samples = one.batch(index)
        beliefs.append(predictor.belief(samples.image, samples.lidar))
        guesses.append(np.asarray(one.guesses[index]))
    all_guesses = np.concatenate(guesses)
    return joined(beliefs), targets(all_guesses), all_guesses


def validate(
    predictor: Predictor, sets: Sequence[SampleSet], per_set: int | None = None
) -> Validation:
    """Return how well a predictor does; arguments as for `predictions`."""
    belief, target, guesses = predictions(predictor, sets, per_set)
    identity = np.broadcast_to(np.eye(4), guesses.shape)
    rough = summary(*pose_errors(identity, guesses))
    metres, radians = pose_errors(euler.transforms(target), belief.transforms)
    curves: dict[str, float] = {}
    by_trace, spread = None, []
    if (belief.scale > 0).all():
        curves = {axis: c.mean_error for axis, c in calibration(belief, target).items()}
        by_trace = ause(metres, belief.variance[:, :3].sum(1))
        spread = sharpness(belief).tolist()
    return Validation(rough, summary(metres, radians), curves, spread, by_trace)


def batches(
    sets: Sequence[SampleSet], per_set: int | None = None, size: int = 16
) -> Iterator[tuple[SampleSet, NDArray[np.int64]]]:
    """Yield sets with the numbers of samples in them; arguments as for `predictions`."""
    for one in sets:
        wanted = min(per_set or len(one), len(one))
        chosen = np.unique(np.linspace(0, len(one) - 1, wanted).astype(np.int64))
        for begin in range(0, len(chosen), size):
            yield one, chosen[begin : begin + size]
