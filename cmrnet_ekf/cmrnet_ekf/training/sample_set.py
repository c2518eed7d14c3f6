"""Keep samples on the disk: images, LiDAR images seen from wrong guesses, and the guesses.

facts.json     format, version, how the images were made, where they are from
frames.npy     [F x H x W x 3] uint8, as the network takes them
lidar.npy      [S x H x W] uint16 depth, 65535 is max_depth
frame_of.npy   [S] which frame belongs to each LiDAR image
guesses.npy    [S x 4 x 4] T_camera_guess, axes forward, left, up
places.npy     [F x 4 x 4] T_map_camera, axes forward, left, up (sets of before may lack it)
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bags.records import CameraModel
from cmrnet_ekf.pose_sampling import targets
from cmrnet_ekf.training.augmentation import augmented
from cmrnet_ekf.training.batch import Batch
from lcd_common.errors import DataError
from lcd_common.se3 import Array

FORMAT, VERSION = 'cmrnet_samples', 1
FULL_SCALE = 65535


class SampleSet:
    """Samples of one drive; arrays stay on the disk until they are asked for."""

    def __init__(self, path: Path) -> None:
        """Open a set.

        Raises:
            DataError: there is none, or its parts do not fit together.
        """
        self.path = path
        try:
            self.facts: dict[str, Any] = json.loads((path / 'facts.json').read_text())
            arrays = [
                np.load(path / f'{name}.npy', mmap_mode='r', allow_pickle=False)
                for name in ('frames', 'lidar', 'frame_of', 'guesses')
            ]
        except (OSError, ValueError) as error:
            raise DataError(
                f'{path}: not a complete set of samples ({error}); make it with make_cmrnet_samples'
            ) from error
        self.frames, self.lidar, self.frame_of, self.guesses = arrays
        if (self.facts.get('format'), self.facts.get('version')) != (FORMAT, VERSION):
            raise DataError(
                f'{path}: expected {FORMAT} of version {VERSION}; make the samples anew'
            )
        if not len(self.lidar) == len(self.frame_of) == len(self.guesses) > 0:
            raise DataError(f'{path}: its parts have different lengths; make the samples anew')
        self._targets = targets(np.asarray(self.guesses))
        self._pinhole = torch.full((4,), torch.nan)
        if 'camera' in self.facts and not any(self.camera.distortion):
            K = self.camera.K
            self._pinhole = torch.tensor([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]).float()
        there = (path / 'places.npy').is_file()
        self.T_map_camera: Array | None = np.load(path / 'places.npy') if there else None

    def __len__(self) -> int:
        return len(self.frame_of)

    @property
    def images(self) -> tuple[float, ...]:
        """Which images these are; see `CmrnetConfig.images`."""
        return tuple(self.facts['images'])

    @property
    def camera(self) -> CameraModel:
        """Calibration of the frames.

        Raises:
            DataError: the set is of before these were kept.
        """
        try:
            given = self.facts['camera']
            K, distortion = np.array(given['K'], np.float64), tuple(given['distortion'])
        except (KeyError, TypeError) as error:
            raise DataError(
                f'{self.path}: does not say what camera it is of; make the samples anew'
            ) from error
        height, width = self.frames.shape[1:3]
        return CameraModel('camera', width, height, K, distortion)

    def batch(self, index: NDArray[np.int64]) -> Batch:
        """Return samples [B]."""
        image = torch.from_numpy(self.frames[self.frame_of[index]]).permute(0, 3, 1, 2)
        depth = self.lidar[index].astype(np.float32) * (self.facts['max_depth'] / FULL_SCALE)
        target = torch.from_numpy(self._targets[index]).float()
        return Batch(image, torch.from_numpy(depth), target, self._pinhole.expand(len(index), 4))

    @property
    def pinhole(self) -> bool:
        """Whether the camera is known and its images are free of distortion."""
        return bool(self._pinhole.isfinite().all())


def draw(
    sets: 'list[SampleSet]', count: int, rng: np.random.Generator, roll: float | None = None
) -> Batch:
    """Return samples drawn from several sets, each sample as likely as any other.

    Args:
        sets: to draw from.
        count: how many.
        rng: draws.
        roll: largest roll of `augmented`, radians; None: samples as they are.
    """
    ends = np.cumsum([len(one) for one in sets])
    chosen = np.sort(rng.integers(0, ends[-1], count))
    which = np.searchsorted(ends, chosen, side='right')
    parts = [sets[k].batch(chosen[which == k] - (ends[k] - len(sets[k]))) for k in np.unique(which)]
    batch = Batch(
        torch.cat([p.image for p in parts]),
        torch.cat([p.lidar for p in parts]),
        torch.cat([p.target for p in parts]),
        torch.cat([p.camera for p in parts]),
    )
    return batch if roll is None else augmented(batch, rng, roll)
