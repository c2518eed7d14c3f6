"""Sweep a scene with a spinning LiDAR."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bags.simulation.hits import Hits
from bags.simulation.lidar_measurement import (
    Echoes,
    Neighbours,
    Surfaces,
    beam_errors,
    calibrated_directions,
    draw,
    measure,
    neighbours,
)
from bags.simulation.lidar_model import LidarModel
from bags.simulation.reflectivity import REFLECTIVITY, patchiness
from bags.street.mesh import RETURN_SHARE
from lcd_common import se3
from lcd_common.cloud import PointCloud

# Casts of one moving sweep: how often the other road users are placed anew.
_PARTS = 6


class Caster(Protocol):
    """Whatever tells what rays hit."""

    def cast(
        self,
        origins: NDArray[np.floating],
        directions: NDArray[np.floating],
        time_s: float = 0.0,
    ) -> Hits:
        """Return what rays [N x 3] hit at a time."""
        ...


@dataclass(frozen=True)
class LidarSweep:
    """One sweep with what its points lie on.

    Attributes:
        cloud: the points in the sensor's frame.
        label: [N] uint8, SemanticKITTI's numbers (bags.street.mesh.Label).
        moving: [N] whether the point lies on something that moves.
        ray: [N] number of the ray, column * beams + beam; one with two echoes comes twice.
    """

    cloud: PointCloud
    label: NDArray[np.uint8]
    moving: NDArray[np.bool_]
    ray: NDArray[np.intp]


class LidarSensor:
    """One LiDAR of a model: its beams keep their own constant errors."""

    def __init__(self, model: LidarModel, caster: Caster, seed: int = 0) -> None:
        """Prepare the rays.

        Args:
            model: what it is.
            caster: of the scene that it sees.
            seed: of the errors of its beams.
        """
        self.model, self._caster = model, caster
        self._shape = (model.columns, len(model.elevation_rad))
        self._directions = model.directions().astype(np.float32)
        self._calibrated = calibrated_directions(model, seed).reshape(-1, 3)
        self._open = np.flatnonzero(model.open_columns())
        self._beam_error_m = beam_errors(model, seed)

    def sweep(
        self, T_world_lidar: se3.Array, time_s: float, rng: np.random.Generator
    ) -> LidarSweep:
        """Return one sweep.

        Args:
            T_world_lidar: one pose [4 x 4], the sweep is a snapshot (or deskewed without error); or
                one for each column [C x 4 x 4]: the points are then in the frames of their own
                columns, as a moving scanner gives them, and carry their time.
            time_s: of the snapshot or of the first column, seconds since the drive's start.
            rng: of all noise.
        """
        moving = T_world_lidar.ndim == 3
        hits = self._cast(T_world_lidar, time_s)
        surfaces = Surfaces(
            hits.range_m.reshape(self._shape),
            hits.incidence.reshape(self._shape),
            self._reflectivity(hits, T_world_lidar),
            RETURN_SHARE[hits.material].astype(np.float32).reshape(self._shape),
        )
        near = neighbours(self.model, rng.random(self._shape, np.float32))
        draws = draw(rng, self._shape, self.model.dual_return)
        echoes = measure(surfaces, near, draws, self.model, self._beam_error_m)
        parts = [self._points(e, near) for e in (echoes, echoes.weaker) if e is not None]
        ray, surface, range_m, bright = (np.concatenate(p) for p in zip(*parts, strict=True))
        if len(parts) > 1:  # in the order in which they come in
            order = np.argsort(ray, kind='stable')
            ray, surface, range_m, bright = (p[order] for p in (ray, surface, range_m, bright))
        xyz = self._calibrated[ray] * range_m[:, None]
        intensity = bright if self.model.has_intensity else None
        at = self.model.column_time_s()[ray // self._shape[1]].astype(np.float32)
        cloud = PointCloud(xyz.astype(np.float32), intensity, at if moving else None)
        return LidarSweep(cloud, hits.label[surface], hits.mover[surface] >= 0, ray)

    def _points(self, echoes: Echoes, near: Neighbours) -> tuple[NDArray[Any], ...]:
        """Return ray, ray of the surface, range and intensity of the echoes that came back."""
        returned = np.isfinite(echoes.range_m)
        blocked = np.ones(len(returned), bool)
        blocked[self._open] = False
        returned[blocked] = False
        ray = np.flatnonzero(returned)
        surface = np.where(echoes.of_neighbour.ravel()[ray], near.index.ravel()[ray], ray)
        return ray, surface, echoes.range_m.ravel()[ray], echoes.intensity.ravel()[ray]

    def _cast(self, T_world_lidar: se3.Array, time_s: float) -> Hits:
        """Return the hits of all rays [C * B]; those of blocked columns hit nothing."""
        beams = self._shape[1]
        if T_world_lidar.ndim == 2:
            parts, times = [self._open], [time_s]
        else:
            parts = [part for part in np.array_split(self._open, _PARTS) if len(part)]
            column_s = self.model.column_time_s()
            times = [time_s + float(column_s[part].mean()) for part in parts]
        count = self._shape[0] * beams
        out = Hits(
            np.full(count, np.inf, np.float32),
            np.ones(count, np.float32),
            np.full(count, -1, np.int32),
            np.zeros(count, np.uint8),
            np.zeros(count, np.uint8),
            np.full(count, -1, np.int16),
        )
        for part, at in zip(parts, times, strict=True):
            T = T_world_lidar.astype(np.float32)
            if T.ndim == 2:
                directions = self._directions[part] @ T[:3, :3].T
                origins = T[None, :3, 3]
            else:
                directions = self._directions[part] @ T[part, :3, :3].swapaxes(1, 2)
                origins = np.repeat(T[part, :3, 3], beams, axis=0)
            hits = self._caster.cast(origins, directions.reshape(-1, 3), at)
            rays = (part[:, None] * beams + np.arange(beams)).ravel()
            for name in ('range_m', 'incidence', 'triangle', 'material', 'label', 'mover'):
                getattr(out, name)[rays] = getattr(hits, name)
        return out

    def _reflectivity(self, hits: Hits, T_world_lidar: se3.Array) -> NDArray[np.float32]:
        """Return the reflectivity [C x B]: no wall and no road is evenly bright."""
        T = np.broadcast_to(T_world_lidar, (self._shape[0], 4, 4)).astype(np.float32)
        range_m = np.where(np.isfinite(hits.range_m), hits.range_m, 0.0).reshape(*self._shape, 1)
        xyz = (range_m * self._directions) @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]
        base = REFLECTIVITY[hits.label, hits.material].reshape(self._shape)
        return np.clip(base * patchiness(xyz), 0.02, 1.0)
