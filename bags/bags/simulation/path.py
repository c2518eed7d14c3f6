"""Lay the line that a car drives along an itinerary: its lane, its turns, its U-turns."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from bags.simulation.itinerary import Itinerary, JourneyConfig, Leg
from bags.simulation.lane import corner_m, farthest_right_m, lane_m
from bags.simulation.street_map import StreetEdge, StreetMap
from lcd_common import se3

STEP_M = 0.25
_DEAD_END_M = 6.0
_SMOOTH_M = 1.0


@dataclass(frozen=True)
class Path:
    """Where a car drives.

    Attributes:
        xy: [N x 2] about STEP_M apart, metres.
        leg: [N] number of the leg that a point belongs to; turns belong to the leg before them.
        ends: [N] whether a point is the last before a crossing, where a car would stop.
    """

    xy: se3.Array
    leg: np.ndarray
    ends: np.ndarray

    def leg_m(self) -> se3.Array:
        """Return the metres driven on each leg [K] of the itinerary, up to the last one reached."""
        steps = np.linalg.norm(np.diff(self.xy, axis=0), axis=1)
        return np.asarray(np.bincount(self.leg[:-1], steps), np.float64)


def lay_path(
    streets: StreetMap, plan: Itinerary, settings: JourneyConfig, rng: np.random.Generator
) -> Path:
    """Return the path along an itinerary, no longer than asked for."""
    strips = [_strip(streets.edges[leg.edge], leg, settings, rng) for leg in plan.legs]
    pieces, owner, ends = [], [], []
    for number, strip in enumerate(strips):
        last = number + 1 == len(strips)
        joined = strip if last else np.concatenate([strip, _turn(strip, strips[number + 1])])
        pieces.append(joined)
        owner += [number] * len(joined)
        ends += [False] * (len(strip) - 1) + [not last] + [False] * (len(joined) - len(strip))
    xy = np.concatenate(pieces)
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    grid = np.arange(0.0, min(s[-1], settings.length), STEP_M)
    even = np.column_stack([np.interp(grid, s, xy[:, 0]), np.interp(grid, s, xy[:, 1])])
    smooth = gaussian_filter1d(even, _SMOOTH_M / STEP_M, axis=0, mode='nearest')
    # The filter pulls the ends inwards and is not even there; what it spoils is left out.
    keep = slice(round(3 * _SMOOTH_M / STEP_M), -round(3 * _SMOOTH_M / STEP_M))
    nearest = np.clip(np.searchsorted(s, grid), 0, len(s) - 1)
    stop = np.zeros(len(grid), bool)
    at = np.searchsorted(grid, s[np.array(ends)])
    stop[at[at < len(grid)]] = True
    return Path(smooth[keep], np.array(owner)[nearest][keep], stop[keep])


def _strip(
    edge: StreetEdge, leg: Leg, settings: JourneyConfig, rng: np.random.Generator
) -> se3.Array:
    """Return the lane along one street [M x 2], without its crossings."""
    line = edge.centreline if leg.forward else edge.centreline[::-1]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    spline = CubicSpline(s, line)
    cut = corner_m(edge)
    end = min(_DEAD_END_M, cut) if leg.turns_back else cut
    at = np.linspace(cut, s[-1] - end, max(8, round((s[-1] - cut - end) / STEP_M)))
    along = spline(at, 1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right = np.column_stack([along[:, 1], -along[:, 0]])
    aside = lane_m(edge)
    if leg.kind != 'new':
        reach = settings.lateral * (1.0 if leg.kind == 'same_way' else 0.4)
        aside += float(rng.uniform(-reach, reach))
    # People do not drive on rails.
    wander = sum(
        rng.uniform(0.02, 0.07) * np.sin(2 * np.pi * (at / rng.uniform(35.0, 110.0) + rng.random()))
        for _ in range(3)
    )
    shifts = np.clip(aside + wander, 0.0, farthest_right_m(edge))
    return np.asarray(spline(at) + shifts[:, None] * right)


def _turn(before: se3.Array, after: se3.Array) -> se3.Array:
    """Return the curve between the lanes of two streets, both ends left out."""
    begin, end = before[-1], after[0]
    d_in = (before[-1] - before[-2]) / np.linalg.norm(before[-1] - before[-2])
    d_out = (after[1] - after[0]) / np.linalg.norm(after[1] - after[0])
    chord = float(np.linalg.norm(end - begin))
    angle = float(np.arccos(np.clip(d_in @ d_out, -1.0, 1.0)))
    if angle > np.radians(165.0):
        return _u_turn(begin, end, d_in)
    # With this length of the tangents a cubic is as good as a circle's arc.
    angle = max(angle, 1e-3)
    reach = chord * 2.0 * np.tan(angle / 4.0) / np.sin(angle / 2.0)
    t = np.linspace(0.0, 1.0, max(4, round(1.2 * chord / STEP_M)))[1:-1, None]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * begin
        + t * (1 - t) ** 2 * reach * d_in
        + t * t * (3 - 2 * t) * end
        - t * t * (1 - t) * reach * d_out
    )


def _u_turn(begin: se3.Array, end: se3.Array, heading: se3.Array) -> se3.Array:
    """Return half a circle to the left, and the straight that may be left over."""
    left = np.array([-heading[1], heading[0]])
    radius = max(0.8, 0.5 * float((end - begin) @ left))
    ahead = max(0.0, float((end - begin) @ heading))
    angle = np.linspace(0.0, np.pi, max(8, round(np.pi * radius / STEP_M)))
    straight = np.arange(STEP_M, ahead, STEP_M)[:, None] * heading
    arc = radius * (np.sin(angle)[:, None] * heading + (1 - np.cos(angle))[:, None] * left)
    start = begin + ahead * heading
    return np.concatenate([begin + straight, start + arc])[:-1]
