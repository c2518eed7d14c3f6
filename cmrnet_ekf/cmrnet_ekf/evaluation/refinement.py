"""Refine samples by one network after the other, each looking from where the last one said."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from cmrnet_ekf.camera_localizer import imager_of
from cmrnet_ekf.evaluation.answers import Answers
from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig, near_origin
from cmrnet_ekf.pose_belief import PoseBelief, joined
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY, targets
from cmrnet_ekf.predictors import Predictor
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.validation import batches
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError

_TILES = 2000  # that stay in memory: neighbouring frames need the same


def refine(
    stages: Sequence[Predictor],
    sets: Sequence[SampleSet],
    per_set: int | None = None,
    progress: Callable[[int], object] = lambda count: None,
) -> list[Answers]:
    """Return what each stage says, of samples of the first one's guesses.

    Raises:
        ConfigError: the stages do not see the same images as the samples.
        DataError: the samples do not say of which map and camera they are.
    """
    if any(tuple(p.settings.images) != one.images for p in stages for one in sets):
        raise ConfigError('all stages must see the images of the samples; make samples for them')
    beliefs: list[list[PoseBelief]] = [[] for _ in stages]
    guesses: list[list[se3.Array]] = [[] for _ in stages]
    maps = {id(one): _map(one) for one in sets}
    for one, index in batches(sets, per_set):
        assert one.T_map_camera is not None
        batch, lidar = one.batch(index), None
        T_camera_guess = np.asarray(one.guesses[index])
        for k, predictor in enumerate(stages):
            lidar = batch.lidar if lidar is None else lidar
            if k:
                T_map_guess = one.T_map_camera[one.frame_of[index]] @ T_camera_guess
                imager = imager_of(one.camera, predictor.settings, predictor.device)
                near = [maps[id(one)].around(T) for T in T_map_guess]
                lidar = imager.images(
                    [points for points, _ in near],
                    [
                        T_OPTICAL_BODY @ se3.inverse(near_origin(T, origin))
                        for T, (_, origin) in zip(T_map_guess, near, strict=True)
                    ],
                )
            belief = predictor.belief(batch.image, lidar)
            beliefs[k].append(belief)
            guesses[k].append(T_camera_guess)
            T_camera_guess = T_camera_guess @ belief.transforms
        progress(len(index))
    return [
        Answers(predictor.kind, joined(beliefs[k]), targets(np.concatenate(guesses[k])))
        for k, predictor in enumerate(stages)
    ]


def _map(one: SampleSet) -> LocalMap:
    if one.T_map_camera is None or 'map' not in one.facts:
        raise DataError(f'{one.path}: does not say where its frames are; make the samples anew')
    return LocalMap(Path(one.facts['map']), LocalMapConfig(kept_tiles=_TILES))
