"""Features of sweeps, computed once: what the place head learns from while the rest is at rest."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_common.weights_file import read, write
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig, augmented
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import PlaceSweep, thinned
from lcd_loop_closure.lcdnet.voxels import Clouds

_BETWEEN_RUNS_M = 1000.0


class DriveSweeps(Protocol):
    """Sweeps of a drive with their true poses, such as `evaluation.sweep_store.StoredSweeps`."""

    T_world_base: NDArray[np.float64]

    def __len__(self) -> int: ...

    def cloud(self, number: int) -> PointCloud:
        """Return one sweep, base frame."""


@dataclass(frozen=True)
class PlaceFeatures:
    """Keypoint features of the sweeps of drives, one drive through each town.

    Attributes:
        values: [S x N x D] float16.
        keypoints: [S x N x 3] float16, metres, base frame of the sweep as it was shown.
        position: [S x 3] metres, true; where augmentation shifted a sweep, where it seems to be.
        town: [S]; positions of different towns have nothing to do with each other.
        path_m: [S] way travelled until the sweep was taken, metres.
    """

    values: Tensor
    keypoints: Tensor
    position: Tensor
    town: Tensor
    path_m: Tensor

    def __len__(self) -> int:
        return len(self.town)

    def save(self, path: Path, made_by: str) -> None:
        """Write them; `made_by` tells which weights and settings made them."""
        tensors = {field.name: getattr(self, field.name) for field in fields(self)}
        write(path, tensors, {'made_by': made_by})

    @classmethod
    def load(cls, path: Path, made_by: str) -> 'PlaceFeatures | None':
        """Read them; None where there are none or other weights made them.

        Raises:
            DataError: the file holds other things.
        """
        if not path.is_file():
            return None
        stored = read(path, writer='train_lcdnet_place_head')
        if stored.facts.get('made_by') != made_by:
            return None
        try:
            return cls(**stored.tensors)
        except TypeError as error:
            raise DataError(f'{path} holds other tensors ({error}); delete it') from error


@torch.inference_mode()
def drive_features(
    network: Lcdnet,
    drive: DriveSweeps,
    town: int,
    augmentation: AugmentationConfig | None,
    *,
    chosen: NDArray[np.intp] | None = None,
    seed: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> PlaceFeatures:
    """Return the features of a drive's sweeps, each augmented once.

    Args:
        network: makes them.
        drive: gives the sweeps.
        town: its number.
        augmentation: None: sweeps are shown as they are.
        chosen: sweeps to take; None: all of them.
        seed: of what is drawn.
        progress: told of each sweep.

    Raises:
        ConfigError: the drive has no sweep.
    """
    if not len(drive):
        raise ConfigError(f'town {town}: expected a drive with sweeps, got none')
    network.eval()
    device = next(network.parameters()).device
    rng = np.random.default_rng([seed, town, 89])
    values, keypoints, position = [], [], []
    taken = np.arange(len(drive)) if chosen is None else chosen
    for number in taken.tolist():
        sweep = _sweep(drive, number)
        xyz, intensity, blind, T = sweep.xyz, sweep.intensity, False, sweep.T_world_base
        if augmentation is not None:
            changed = augmented(sweep, augmentation, rng)
            xyz, intensity = changed.xyz, changed.intensity
            T = T @ se3.inverse(changed.T_new_base)
            blind = rng.random() < augmentation.no_intensity_share
        light = None if blind else [torch.from_numpy(intensity).to(device)]
        seen = network(Clouds.of([torch.from_numpy(xyz).to(device)], light))
        values.append(seen.features[0].half().cpu())
        keypoints.append(seen.keypoints[0].half().cpu())
        position.append(T[:3, 3])
        progress()
    step_m = np.linalg.norm(np.diff(drive.T_world_base[:, :3, 3], axis=0), axis=1)
    return PlaceFeatures(
        torch.stack(values),
        torch.stack(keypoints),
        torch.from_numpy(np.array(position, np.float64)),
        torch.full((len(taken),), town),
        torch.from_numpy(np.concatenate([[0.0], np.cumsum(step_m)])[taken]),
    )


def around_loops(drive: DriveSweeps, *, loop_m: float, around_m: float) -> NDArray[np.intp]:
    """Return the sweeps [K] that lie near a spot to which the drive returned.

    Args:
        drive: gives the poses.
        loop_m: sweeps this near to each other, 50 m of way apart, are a return.
        around_m: how far from one of these.
    """
    position = drive.T_world_base[:, :3, 3]
    away = np.linalg.norm(position[:, None] - position, axis=2)
    step_m = np.linalg.norm(np.diff(position, axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(step_m)])
    loops = ((away <= loop_m) & (np.abs(path_m[:, None] - path_m) > 50.0)).any(1)
    return np.flatnonzero((away[:, loops] <= around_m).any(1))


def near_spots(drive: DriveSweeps, spots: NDArray[np.float64], around_m: float) -> NDArray[np.intp]:
    """Return the sweeps [K] of a drive within a distance of some spots [S x 3]."""
    away = np.linalg.norm(drive.T_world_base[:, None, :3, 3] - spots, axis=2)
    return np.flatnonzero((away <= around_m).any(1))


def second_run(first: PlaceFeatures, second: PlaceFeatures) -> PlaceFeatures:
    """Return both runs through a town as one drive: whatever the second sees is a return."""
    after_m = float(first.path_m.max()) + _BETWEEN_RUNS_M
    return joined_features([first, replace(second, path_m=second.path_m + after_m)])


def joined_features(parts: Sequence[PlaceFeatures]) -> PlaceFeatures:
    """Return the features of several drives; raises ConfigError when there are none."""
    if not parts:
        raise ConfigError('expected the features of at least one drive, got none')
    names = [field.name for field in fields(PlaceFeatures)]
    return PlaceFeatures(
        **{name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    )


def _sweep(drive: DriveSweeps, number: int) -> PlaceSweep:
    cloud = thinned(drive.cloud(number).finite())
    light = np.zeros(len(cloud)) if cloud.intensity is None else cloud.intensity
    return PlaceSweep(
        np.ascontiguousarray(cloud.xyz, np.float32),
        np.clip(np.asarray(light, np.float32), 0.0, 1.0),
        drive.T_world_base[number],
    )
