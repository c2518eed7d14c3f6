"""Cast a spinning LiDAR's rays in pure torch: triangles are drawn into its range image.

No tree over the triangles is needed: each one covers a window of columns and beams, and only the
rays in the window are tested against it. Windows are exact, so the answer is Embree's.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from bags.simulation.lidar_measurement import calibrated_directions
from bags.simulation.lidar_model import LidarModel
from bags.simulation.scene import Scene
from bags.street.mesh import MOVING
from lcd_common.errors import ConfigError

_TWO_PI = 2.0 * np.pi
_PAIRS = 2_000_000  # tested at a time on a CPU: what its caches and memory like
_EDGE = 1e-7  # rays this near an edge count as inside, so that meshes have no cracks


@dataclass(frozen=True)
class RasterHits:
    """What the rays of a sweep hit, [C x B] each; of several sweeps [P x C x B].

    Attributes:
        range_m: infinity where nothing is hit.
        incidence: cosine of the angle to the normal, 0..1; 0 where nothing is hit.
        triangle: of the standing mesh; -1 where nothing or a mover is hit.
        material, label: bags.street.mesh.Material and Label; 0 where nothing is hit.
        moving: whether it is a mover.
    """

    range_m: torch.Tensor
    incidence: torch.Tensor
    triangle: torch.Tensor
    material: torch.Tensor
    label: torch.Tensor
    moving: torch.Tensor


@dataclass(frozen=True)
class _Triangles:
    """Triangles in reach of the poses: [K x 3 x 3] in the lidar frame, whose pose, and what of.

    `number` is that of the standing mesh's triangle, -1 for a mover's.
    """

    corners: torch.Tensor
    pose: torch.Tensor
    number: torch.Tensor
    material: torch.Tensor
    label: torch.Tensor


class LidarRaster:
    """Hold a scene on a device and cast sweeps into it."""

    def __init__(self, scene: Scene, model: LidarModel, device: torch.device | str = 'cpu') -> None:
        """Move the scene to the device; beams must come from top to bottom."""
        self.scene, self.device = scene, torch.device(device)
        mesh = scene.mesh
        self._corners = self._on_device(mesh.vertices[mesh.triangles])  # [T x 3 x 3]
        self._centre = self._corners.mean(1)
        self._reach = (self._corners - self._centre[:, None]).norm(dim=2).amax(1)
        self._materials = self._on_device(mesh.materials.astype(np.int64))
        self._labels = self._on_device(mesh.labels.astype(np.int64))
        self._prepare(model)

    def look_with(self, model: LidarModel) -> None:
        """Use another LiDAR from now on.

        Raises:
            ConfigError: its beams do not come from top to bottom.
        """
        if model is not self.model:
            self._prepare(model)

    def _prepare(self, model: LidarModel) -> None:
        tangent = np.tan(model.elevation_rad)
        if not np.all(np.diff(tangent) < 0):
            raise ConfigError(f'the beams of {model.name} must come from top to bottom')
        self.model = model
        self._falling = self._on_device(-tangent.astype(np.float32))
        directions = np.ascontiguousarray(model.directions().reshape(-1, 3), np.float32)
        self._directions = self._on_device(directions)
        self._calibrated: dict[int, torch.Tensor] = {}

    @property
    def directions(self) -> torch.Tensor:
        """Unit vectors [C x B x 3] of the rays, lidar frame."""
        return self._directions.view(self.model.columns, -1, 3)

    def calibrated(self, seed: int) -> torch.Tensor:
        """Return where the calibration of one sensor says the rays point [C x B x 3]."""
        if seed not in self._calibrated:
            self._calibrated[seed] = self._on_device(calibrated_directions(self.model, seed))
        return self._calibrated[seed]

    def cast(self, T_world_lidar: np.ndarray, time_s: float | np.ndarray = 0.0) -> RasterHits:
        """Return what sweeps hit, all cast at once.

        Args:
            T_world_lidar: one pose [4 x 4], or several [P x 4 x 4].
            time_s: of the sweep, or of each of them [P].
        """
        poses = np.asarray(T_world_lidar, np.float32).reshape(-1, 4, 4)
        times = np.broadcast_to(np.asarray(time_s, np.float64), len(poses))
        triangles = self._around(poses, times)
        columns, beams = self.model.columns, len(self.model.elevation_rad)
        first_column, n_columns = self._column_window(triangles.corners)
        first_beam, n_beams = self._beam_window(triangles.corners)
        count = n_columns * n_beams
        seen = torch.nonzero(count > 0).squeeze(1)
        count, before = count[seen], triangles.pose[seen] * (columns * beams)
        window = torch.stack([first_column[seen], first_beam[seen], n_beams[seen], before], 1)
        planes = _planes(triangles.corners[seen])
        rays = len(poses) * columns * beams
        range_m = torch.full((rays,), torch.inf, device=self.device)
        triangle = torch.full((rays,), -1, dtype=torch.int64, device=self.device)
        for begin, end in self._pieces(count):
            self._draw(planes, window, count, begin, end, range_m, triangle)
        far = range_m > self.model.max_range_m
        range_m[far], triangle[far] = torch.inf, -1
        hit, at = triangle >= 0, triangle.clamp(min=0)
        shape = (*np.shape(T_world_lidar)[:-2], columns, beams)
        if not len(seen):
            nothing = torch.zeros_like(triangle)
            parts = [range_m, torch.zeros_like(range_m), triangle, nothing, nothing, nothing > 0]
            return RasterHits(*(part.view(shape) for part in parts))
        normal, number = planes[at, 3], seen[at]
        along = (normal.view(len(poses), -1, 3) * self._directions).sum(2).view(-1)
        cosine = along.abs() / normal.norm(dim=1).clamp(min=1e-12)
        parts = [
            range_m,
            torch.where(hit, cosine, 0.0 * cosine),
            torch.where(hit, triangles.number[number], triangle),
            torch.where(hit, triangles.material[number], 0 * number),
            torch.where(hit, triangles.label[number], 0 * number),
            hit & (triangles.number[number] < 0),
        ]
        return RasterHits(*(part.view(shape) for part in parts))

    def _around(self, poses: np.ndarray, times_s: np.ndarray) -> '_Triangles':
        """Return the triangles in reach of each pose, in its own frame."""
        R, t = self._on_device(poses[:, :3, :3]), self._on_device(poses[:, :3, 3])
        away = torch.stack([(self._centre - own).norm(dim=1) for own in t]) - self._reach
        pose, near = torch.nonzero(away < self.model.max_range_m).unbind(1)
        parts = [(pose, self._corners[near], near, self._materials[near], self._labels[near])]
        for index, (T, time_s) in enumerate(zip(poses, times_s.tolist(), strict=True)):
            moving = self._movers(T[:3, 3], time_s)
            if moving is not None:
                none = torch.full_like(moving[1], -1)
                parts.append((torch.full_like(none, index), moving[0], none, moving[1], moving[2]))
        pose, corners, number, material, label = (torch.cat(p) for p in zip(*parts, strict=True))
        # R^T (p - t), row by row.
        return _Triangles(
            torch.bmm(corners - t[pose][:, None], R[pose]), pose, number, material, label
        )

    def _movers(
        self, origin: np.ndarray, time_s: float
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None:
        """Return corners, materials and labels of the movers in reach."""
        corners, materials, labels = [], [], []
        for mover in self.scene.movers:
            T = mover.at(time_s)
            if T is None or np.linalg.norm(T[:3, 3] - origin) > self.model.max_range_m + 10.0:
                continue
            placed = (mover.mesh.vertices @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
            corners.append(placed[mover.mesh.triangles])
            materials.append(mover.mesh.materials.astype(np.int64))
            labels.append(MOVING[mover.mesh.labels])
        if not corners:
            return None
        return (
            self._on_device(np.concatenate(corners)),
            self._on_device(np.concatenate(materials)),
            self._on_device(np.concatenate(labels).astype(np.int64)),
        )

    def _on_device(self, array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(array), device=self.device)

    def _draw(
        self,
        planes: torch.Tensor,
        window: torch.Tensor,
        count: torch.Tensor,
        begin: int,
        end: int,
        range_m: torch.Tensor,
        triangle: torch.Tensor,
    ) -> None:
        """Test triangles begin..end against the rays of their windows; keep what is nearest."""
        columns, beams = self.model.columns, len(self.model.elevation_rad)
        number = count[begin:end]
        which = torch.repeat_interleave(
            torch.arange(begin, end, device=self.device), number, output_size=int(number.sum())
        )
        start = torch.cumsum(number, 0) - number
        place = torch.arange(len(which), device=self.device) - start[which - begin]
        first_column, first_beam, n_beams, before = window[which].unbind(1)
        column = torch.div(place, n_beams, rounding_mode='floor')
        ray = (first_column + column) % columns * beams + first_beam + place - column * n_beams
        own, d = planes[which], self._directions[ray]
        ray = ray + before
        sides = torch.bmm(own[:, :4], d[:, :, None]).squeeze(2)  # three edges, then the normal
        edges = sides[:, :3]
        inside = (edges >= -_EDGE).all(1) | (edges <= _EDGE).all(1)
        distance = own[:, 4, 0] / sides[:, 3]
        ok = torch.nonzero(inside & (distance > 0.0) & torch.isfinite(distance)).squeeze(1)
        ray, distance, which = ray[ok], distance[ok], which[ok]
        nearest = torch.full_like(range_m, torch.inf)
        nearest.scatter_reduce_(0, ray, distance, 'amin')
        better = torch.nonzero((distance == nearest[ray]) & (distance < range_m[ray])).squeeze(1)
        triangle[ray[better]] = which[better]
        range_m[ray[better]] = distance[better]

    def _pieces(self, count: torch.Tensor) -> list[tuple[int, int]]:
        if self.device.type != 'cpu':
            return [(0, len(count))]
        total = torch.cumsum(count, 0)
        if not len(total):
            return []
        marks = torch.arange(_PAIRS, int(total[-1]) + _PAIRS, _PAIRS)
        ends = torch.searchsorted(total, marks).clamp(max=len(count) - 1) + 1
        edges = torch.unique(torch.cat([torch.zeros(1, dtype=torch.int64), ends])).tolist()
        return list(pairwise(edges))

    def _column_window(self, corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the first column and the number of columns that each triangle may cover."""
        columns = self.model.columns
        azimuth = torch.atan2(corners[..., 1], corners[..., 0])
        turn = azimuth[:, 1:] - azimuth[:, :1]
        turn = turn - _TWO_PI * torch.round(turn / _TWO_PI)
        low = azimuth[:, 0] + turn.amin(1).clamp(max=0.0)
        high = azimuth[:, 0] + turn.amax(1).clamp(min=0.0)
        slack = 1e-4
        first = torch.ceil((np.pi - high) / _TWO_PI * columns - 0.5 - slack)
        last = torch.floor((np.pi - low) / _TWO_PI * columns - 0.5 + slack)
        # A triangle above or below the sensor, or one that nearly is, is seen all around.
        around = _on_axis(corners) | (high - low > 0.9 * np.pi)
        first = torch.where(around, torch.zeros_like(first), first)
        number = torch.where(around, torch.full_like(first, columns), last - first + 1)
        return first.long(), number.long().clamp(0, columns)

    def _beam_window(self, corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the first beam and the number of beams that each triangle may cover."""
        level = corners[..., :2].norm(dim=2).clamp(min=1e-9)
        tangent = corners[..., 2] / level
        low, high = tangent.amin(1), tangent.amax(1)
        # An edge is steepest or flattest within at most one place: d(z/r) = 0 along it.
        step = corners.roll(-1, 1) - corners
        a = (step[..., :2] ** 2).sum(2)
        b = (corners[..., :2] * step[..., :2]).sum(2)
        c = (corners[..., :2] ** 2).sum(2)
        z, dz = corners[..., 2], step[..., 2]
        t = ((z * b - dz * c) / (dz * b - z * a)).nan_to_num(0.0, 0.0, 0.0).clamp(0.0, 1.0)
        at = corners + t[..., None] * step
        between = at[..., 2] / at[..., :2].norm(dim=2).clamp(min=1e-9)
        low, high = torch.minimum(low, between.amin(1)), torch.maximum(high, between.amax(1))
        around = _on_axis(corners)
        above = corners[..., 2].mean(1) > 0
        high = torch.where(around & above, torch.full_like(high, torch.inf), high)
        low = torch.where(around & ~above, torch.full_like(low, -torch.inf), low)
        slack = 1e-5 * (1.0 + torch.maximum(low.abs(), high.abs()).nan_to_num(posinf=1.0))
        first = torch.searchsorted(self._falling, -(high + slack))
        last = torch.searchsorted(self._falling, -(low - slack), right=True)
        return first, (last - first).clamp(min=0)


def _on_axis(corners: torch.Tensor) -> torch.Tensor:
    """Tell whether the sensor's vertical axis passes through a triangle."""
    x, y = corners[..., 0], corners[..., 1]
    cross = x * y.roll(-1, 1) - x.roll(-1, 1) * y
    return (cross > 0.0).all(1) | (cross < 0.0).all(1)


def _planes(corners: torch.Tensor) -> torch.Tensor:
    """Return per triangle the normals of its three edges' planes through the sensor, its own.

    The fifth row holds the distance of its plane times the length of its normal: [T x 5 x 3].
    """
    # In double precision: the products of metres lose what decides at shared edges.
    p = corners.double()
    edges = torch.cross(p, p.roll(-1, 1), dim=2)
    edges = edges / edges.norm(dim=2, keepdim=True).clamp(min=1e-12)
    normal = torch.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], dim=1)
    offset = (normal * p[:, 0]).sum(1)[:, None, None].expand(-1, 1, 3)
    return torch.cat([edges, normal[:, None], offset], 1).float()
