"""Find the stretch of a drive where localization is worst (Fig. 5.6)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.evaluation.answers import Answers
from cmrnet_ekf.evaluation.measures import SHARE
from cmrnet_ekf.rejection import accepted, traces
from cmrnet_ekf.training.sample_set import SampleSet
from cmrnet_ekf.training.validation import batches
from lcd_common.se3 import Array

FRAMES = 125  # the thesis's


@dataclass(frozen=True)
class Located:
    """Where one method put the frames of a stretch.

    Attributes:
        positions: [F x 2] of the camera in the map, metres.
        metres: [F] errors.
        kept: [F] not rejected; all are of a method that does not know.
    """

    positions: Array
    metres: Array
    kept: NDArray[np.bool_]


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames: where they were taken [F x 2], and where methods put them."""

    drive: str
    truth: Array
    located: dict[str, Located]

    def plain(self) -> dict[str, object]:
        """Return what was rejected, and how large errors are with and without it."""
        return {
            'drive': self.drive,
            'frames': len(self.truth),
            'methods': {
                name: {
                    't_mean_m': float(one.metres.mean()),
                    't_mean_kept_m': float(one.metres[one.kept].mean()) if one.kept.any() else None,
                    'rejected': int((~one.kept).sum()),
                    'failures_1m': int((one.metres > 1.0).sum()),
                    'failures_1m_rejected': int(((one.metres > 1.0) & ~one.kept).sum()),
                }
                for name, one in self.located.items()
            },
        }


def worst_stretch(
    answers: dict[str, Answers],
    sets: Sequence[SampleSet],
    per_set: int | None = None,
    frames: int = FRAMES,
) -> Stretch | None:
    """Return the frames in a row where the first method errs most; one guess of each frame.

    Thresholds of rejection are those of all samples. None when no set says where its frames are.
    """
    if not answers:
        return None
    first = next(iter(answers.values())).errors[0]
    best: tuple[float, SampleSet, NDArray[np.int64], NDArray[np.int64]] | None = None
    begin = 0
    for one in sets:
        index = np.concatenate([part for _, part in batches([one], per_set)])
        rows = begin + np.arange(len(index))
        begin += len(index)
        if one.T_map_camera is None:
            continue
        _, seen = np.unique(one.frame_of[index], return_index=True)
        count = min(frames, len(seen))
        sums = np.convolve(first[rows[seen]], np.ones(count), 'valid') / count
        at = int(sums.argmax())
        if best is None or sums[at] > best[0]:
            part = seen[at : at + count]
            best = float(sums[at]), one, index[part], rows[part]
    if best is None:
        return None
    _, chosen, index, rows = best
    assert chosen.T_map_camera is not None
    T_map_camera = chosen.T_map_camera[chosen.frame_of[index]]
    T_map_guess = T_map_camera @ np.asarray(chosen.guesses[index])
    located = {}
    for name, said in answers.items():
        kept = np.ones(len(rows), np.bool_)
        if said.knows:
            kept = accepted(traces(said.belief), SHARE)[rows]
        T_map_found = T_map_guess @ said.belief.rows(rows).transforms
        located[name] = Located(T_map_found[:, :2, 3], said.errors[0][rows], kept)
    return Stretch(str(chosen.facts['drive']), T_map_camera[:, :2, 3], located)
