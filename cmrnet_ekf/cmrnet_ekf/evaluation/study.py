"""Judge methods on samples: all that `evaluate_cmrnet` writes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from cmrnet_ekf.evaluation import measures
from cmrnet_ekf.evaluation.answers import Answers, ask
from cmrnet_ekf.evaluation.named_networks import ROUGH
from cmrnet_ekf.evaluation.refinement import refine
from cmrnet_ekf.evaluation.stretch import Stretch, worst_stretch
from cmrnet_ekf.localization_errors import LocalizationErrors, pose_errors, summary
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.validation import batches
from lcd_common.errors import ConfigError

MCD_SAMPLES = 30


@dataclass(frozen=True)
class Study:
    """What methods said of samples.

    Attributes:
        sets: names of the drives.
        rough: errors of the guesses.
        answers: of one pass, by name.
        refined: after each stage, by name.
        stretch: where localization is worst, if the samples say where they are.
    """

    sets: tuple[str, ...]
    rough: LocalizationErrors
    answers: dict[str, Answers]
    refined: dict[str, list[Answers]] = field(default_factory=dict)
    stretch: Stretch | None = None

    @property
    def knowing(self) -> dict[str, Answers]:
        """The methods that say how sure they are."""
        return {name: one for name, one in self.answers.items() if one.knows}

    def plain(self) -> dict[str, Any]:
        """Return all figures."""
        known = {name: measures.of_uncertainty(one) for name, one in self.knowing.items()}
        figures: dict[str, Any] = {
            'drives': list(self.sets),
            'samples': self.rough.count,
            'kinds': {name: one.kind for name, one in self.answers.items()},
            'localization': {
                ROUGH: asdict(self.rough),
                **{name: asdict(one.summary()) for name, one in self.answers.items()},
            },
        }
        for key in ('calibration', 'calibration_std', 'sharpness', 'ause'):
            figures[key] = {name: found[key] for name, found in known.items()}
        figures['rejection'] = {
            name: measures.after_rejection(one) for name, one in self.knowing.items()
        }
        figures['by_confidence'] = {
            name: measures.by_confidence(one) for name, one in self.knowing.items()
        }
        figures['by_count'] = {
            name: measures.by_count(one)
            for name, one in self.answers.items()
            if one.draws is not None
        }
        figures['refined'] = {
            name: {
                f'after_stage_{k}': asdict(one.summary()) for k, one in enumerate(stages, start=1)
            }
            for name, stages in self.refined.items()
        }
        figures['stretch'] = None if self.stretch is None else self.stretch.plain()
        return figures


def study(
    first: Mapping[str, Predictor],
    sets: Sequence[SampleSet],
    later: Sequence[Mapping[str, Predictor]] = (),
    per_set: int | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> Study:
    """Ask methods about samples.

    Args:
        first: predictors by name; those of MC dropout may draw more than MCD_SAMPLES, the belief is
            made of so many and the rest shows what more would give.
        sets: of samples, one drive each.
        later: networks of the second stage, of the third, by the same names.
        per_set: samples of each set, evenly chosen; None: all.
        progress: called with how many samples were asked.

    Raises:
        ConfigError: a later stage has a name that an earlier one has not, or images do not fit.
    """
    earlier = set(first)
    for number, stage in enumerate(later, start=2):
        strange = sorted(set(stage) - earlier)
        if strange:
            raise ConfigError(f'stage {number} has {", ".join(strange)}, the stage before has not')
        earlier = set(stage)
    guesses = np.concatenate([one.guesses[index] for one, index in batches(sets, per_set)])
    rough = summary(*pose_errors(np.broadcast_to(np.eye(4), guesses.shape), guesses))
    answers = {
        name: ask(predictor, sets, per_set, MCD_SAMPLES, progress)
        for name, predictor in first.items()
    }
    refined = {}
    for name in later[0] if later else ():
        stages = [s[name].with_samples(MCD_SAMPLES) for s in (first, *later) if name in s]
        refined[name] = refine(stages, sets, per_set, progress)
    drives = tuple(str(one.facts['drive']) for one in sets)
    return Study(drives, rough, answers, refined, worst_stretch(answers, sets, per_set))
