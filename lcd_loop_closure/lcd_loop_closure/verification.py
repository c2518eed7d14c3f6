"""Decide whether two registered clouds show the same place.

Registration always finds some pose. These checks ask what only the right one can answer: do the
things that stand on the ground have partners in both directions, does each cloud keep out of the
space that the other's rays have seen to be empty, and do both vehicles stand upright on one ground?
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.refinement import Surface


@config
class VerificationConfig:
    """Limits of the checks."""

    partner_distance: float = setting(
        0.4, 'two points farther apart are no partners', unit='m', low=0.05
    )
    structure_height: float = setting(
        0.5, 'points lower above the ground do not count: ground fits everywhere', unit='m'
    )
    min_structure: int = setting(200, 'fewest points above the ground that can decide', low=10)
    min_fitness: float = setting(
        0.3, 'smallest share of the structure of the query with a partner', low=0.0, high=1.0
    )
    min_overlap: float = setting(
        0.25, 'smallest share, of either cloud, of structure with a partner', low=0.0, high=1.0
    )
    max_violations: float = setting(
        0.15, 'largest share of structure in space that was seen empty', low=0.0, high=1.0
    )
    free_margin: float = setting(
        1.0, 'a ray must pass a point by this much to contradict it', unit='m', low=0.1
    )
    max_tilt: float = setting(8.0, 'largest roll or pitch between both', unit='deg', low=0.5)
    max_climb: float = setting(2.0, 'largest difference in height', unit='m', low=0.1)
    max_distance: float = setting(20.0, 'largest distance between both', unit='m', low=1.0)


@dataclass(frozen=True)
class Verdict:
    """Result of the checks.

    Attributes:
        fitness: share of the query's structure with a partner, 0..1.
        overlap: smaller share of both directions, 0..1.
        rmse_m: of partnered points, metres; None without partners.
        inliers: partnered points of the query.
        violations: larger share of both directions of structure in seen-empty space, 0..1.
        status, reason: ACCEPTED or why not, one sentence with value and limit.
    """

    fitness: float
    overlap: float
    rmse_m: float | None
    inliers: int
    violations: float
    status: LoopStatus
    reason: str


class RangeView:
    """How far a cloud's sensor saw in each direction: the nearest return around each ray.

    The image is coarse because keyframe clouds are thin; a direction counts as seen only where the
    cloud has returns.
    """

    columns = 180
    rows = 40
    elevation = np.radians(26.0)

    def __init__(self, xyz: NDArray[np.float64], origin: NDArray[np.float64]) -> None:
        self._origin = origin
        at, distance, inside = self._project(xyz)
        flat = np.full(self.rows * self.columns, np.inf)
        np.minimum.at(flat, at[inside], distance[inside])
        image = flat.reshape(self.rows, self.columns)
        seen = np.isfinite(image)
        # Nearest over the neighbourhood: an edge of an obstacle must not look like free space.
        nearest = image.copy()
        for up in (-1, 0, 1):
            for left in (-1, 0, 1):
                moved = np.roll(image, (up, left), axis=(0, 1))
                if up:
                    moved[-1 if up < 0 else 0] = np.inf
                nearest = np.minimum(nearest, moved)
        self._limit = np.where(seen, nearest, -np.inf).ravel()

    def violations(self, xyz: NDArray[np.float64], margin_m: float) -> tuple[int, int]:
        """Count the points [N x 3, this cloud's frame] in seen-empty space, and all in view."""
        at, distance, inside = self._project(xyz)
        limit = self._limit[at[inside]]
        in_view = np.isfinite(limit)
        gone = distance[inside] + margin_m < limit
        return int(np.count_nonzero(gone & in_view)), int(np.count_nonzero(in_view))

    def _project(
        self, xyz: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
        v = xyz - self._origin
        flat = np.hypot(v[:, 0], v[:, 1])
        azimuth = np.arctan2(v[:, 1], v[:, 0]) / (2 * np.pi) % 1.0
        elevation = np.arctan2(v[:, 2], flat) / self.elevation * 0.5 + 0.5
        column = np.minimum((azimuth * self.columns).astype(np.int64), self.columns - 1)
        row = np.floor(elevation * self.rows).astype(np.int64)
        inside = (row >= 0) & (row < self.rows) & (flat > 0)
        return np.where(inside, row * self.columns + column, 0), np.hypot(flat, v[:, 2]), inside


class Verification:
    """Check a refined pose from both clouds."""

    def __init__(
        self,
        settings: VerificationConfig | None = None,
        sensor_origin: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the limits and the sensor's position [3] in the base frame, metres."""
        self.settings = settings or VerificationConfig()
        self._origin = np.array([0.0, 0.0, 1.73]) if sensor_origin is None else sensor_origin

    def range_view(self, xyz: NDArray[np.floating]) -> RangeView:
        """Return how far the sensor of a cloud [N x 3] saw; needed once for each cloud."""
        return RangeView(np.asarray(xyz, np.float64), self._origin)

    def fitness(
        self, match: Surface, query: Surface, T_match_query: se3.Array, query_ground_z: float
    ) -> float:
        """Return the share of the query's structure with a partner in the match, 0..1."""
        xyz = self._structure(query, query_ground_z)
        if not len(xyz):
            return 0.0
        _, distance = match.nearest(xyz @ T_match_query[:3, :3].T + T_match_query[:3, 3])
        return float(np.mean(distance < self.settings.partner_distance))

    def check(
        self,
        match: Surface,
        query: Surface,
        match_view: RangeView,
        query_view: RangeView,
        T_match_query: se3.Array,
        ground_z: tuple[float, float] = (0.0, 0.0),
    ) -> Verdict:
        """Judge `T_match_query`; `ground_z` is the ground's height in the match and the query."""
        s = self.settings
        in_match = self._structure(query, ground_z[1])
        in_match = in_match @ T_match_query[:3, :3].T + T_match_query[:3, 3]
        in_query = self._structure(match, ground_z[0])
        in_query = (in_query - T_match_query[:3, 3]) @ T_match_query[:3, :3]
        if min(len(in_match), len(in_query)) < s.min_structure:
            return Verdict(
                0.0,
                0.0,
                None,
                0,
                0.0,
                LoopStatus.REJECTED_REGISTRATION,
                f'{min(len(in_match), len(in_query))} points above the ground, '
                f'at least {s.min_structure} are needed',
            )
        to_match = match.nearest(in_match)[1]
        to_query = query.nearest(in_query)[1]
        partnered = to_match[to_match < s.partner_distance]
        fitness = len(partnered) / len(to_match)
        overlap = min(fitness, float(np.mean(to_query < s.partner_distance)))
        violations = 0.0
        for view, points in ((match_view, in_match), (query_view, in_query)):
            gone, in_view = view.violations(points, s.free_margin)
            violations = max(violations, gone / max(in_view, 1))
        rmse_m = float(np.sqrt(np.mean(partnered**2))) if len(partnered) else None
        status, reason = self._verdict(T_match_query, ground_z, fitness, overlap, violations)
        return Verdict(fitness, overlap, rmse_m, len(partnered), violations, status, reason)

    def _structure(self, surface: Surface, ground_z: float) -> NDArray[np.float64]:
        return surface.xyz[surface.xyz[:, 2] > ground_z + self.settings.structure_height]

    def _verdict(
        self,
        T_match_query: se3.Array,
        ground_z: tuple[float, float],
        fitness: float,
        overlap: float,
        violations: float,
    ) -> tuple[LoopStatus, str]:
        s = self.settings
        distance = float(np.linalg.norm(T_match_query[:3, 3]))
        tilt = float(np.degrees(np.arccos(np.clip(T_match_query[2, 2], -1.0, 1.0))))
        climb = abs(float(T_match_query[2, 3]) - (ground_z[0] - ground_z[1]))
        unlikely = LoopStatus.REJECTED_REGISTRATION
        if distance > s.max_distance:
            return unlikely, f'distance {distance:.1f} m exceeds {s.max_distance:g} m'
        if tilt > s.max_tilt:
            return unlikely, f'roll and pitch of {tilt:.1f} deg exceed {s.max_tilt:g} deg'
        if climb > s.max_climb:
            return unlikely, f'height difference {climb:.2f} m exceeds {s.max_climb:g} m'
        if fitness < s.min_fitness:
            return (
                LoopStatus.REJECTED_FITNESS,
                f'fitness {fitness:.2f} is below {s.min_fitness:g}',
            )
        if overlap < s.min_overlap:
            return (
                LoopStatus.REJECTED_OVERLAP,
                f'overlap {overlap:.2f} is below {s.min_overlap:g}',
            )
        if violations > s.max_violations:
            return (
                LoopStatus.REJECTED_OVERLAP,
                f'{violations:.2f} of the structure lies in space seen empty, '
                f'at most {s.max_violations:g} is allowed',
            )
        return LoopStatus.ACCEPTED, f'fitness {fitness:.2f}, overlap {overlap:.2f}'
