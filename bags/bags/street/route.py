"""Plan how a car drives through waypoints: round corners, limited acceleration, turns in place."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

Array = NDArray[np.float64]
_RATE_HZ = 100.0
_PATH_STEP_M = 0.1
_SMOOTH_M = 1.0
_SMOOTH_S = 0.15


class Route:
    """A planar motion built leg by leg; legs start and end at rest, but the first starts at speed.

    `Route().through([(0, 0), (80, 0), (80, 60)]).turn(np.pi, seconds=3).through(...)`
    """

    def __init__(self, speed: float = 10.0, corner_radius: float = 8.0) -> None:
        """Start an empty route.

        Args:
            speed: top speed, m/s; corners are slower (2.5 m/s^2 sideways).
            corner_radius: of the corners where the waypoints leave room for it, metres.
        """
        self.speed, self.corner_radius = speed, corner_radius
        self.centrelines: list[Array] = []
        self._xy_yaw: list[Array] = []
        self._splined: CubicSpline | None = None

    def through(self, waypoints: ArrayLike, lane: float | Sequence[float] = 1.75) -> 'Route':
        """Drive along streets.

        Args:
            waypoints: [N x 2] corners of the street's centreline, metres.
            lane: how far right of the centreline to drive, for all or for each of the N - 1
                stretches, metres.
        """
        centreline = np.asarray(waypoints, np.float64)
        if centreline.ndim != 2 or centreline.shape[1] != 2 or len(centreline) < 2:
            raise ValueError(
                f'a route needs at least two waypoints x y, got the shape {centreline.shape}'
            )
        lanes = np.broadcast_to(np.asarray(lane, np.float64), len(centreline) - 1)
        corners = _beside(centreline, lanes)
        if self._xy_yaw:  # begin where the last leg stopped
            corners[0] = self._xy_yaw[-1][-1, :2]
        path = _rounded(corners, self.corner_radius)
        if self._xy_yaw:
            leg = _driven(_smoothed(path), self.speed)
        else:
            leg = _driven(_smoothed(_with_run_up(path)), self.speed)
            leg = leg[np.argmin(np.linalg.norm(leg[:, :2] - corners[0], axis=1)) :]
        self._append(leg)
        self.centrelines.append(centreline)
        return self

    def turn(self, angle: float, seconds: float) -> 'Route':
        """Turn on the spot by `angle` radians (left is positive)."""
        x, y, yaw = self._xy_yaw[-1][-1]
        share = np.linspace(0.0, 1.0, max(2, round(seconds * _RATE_HZ)) + 1)[1:]
        yaws = yaw + angle * share * share * (3 - 2 * share)
        self._append(np.stack([np.full_like(yaws, x), np.full_like(yaws, y), yaws], axis=1))
        return self

    def stand(self, seconds: float) -> 'Route':
        """Wait."""
        self._append(np.repeat(self._xy_yaw[-1][-1:], round(seconds * _RATE_HZ), axis=0))
        return self

    @property
    def duration_s(self) -> float:
        """How long the route takes."""
        return (sum(len(leg) for leg in self._xy_yaw) - 1) / _RATE_HZ

    def at(self, time_s: ArrayLike) -> Array:
        """Return x, y (m), unwrapped yaw (rad) and distance travelled (m) [N x 4].

        Before its start and after its end the route goes straight on with the speed it had there.
        """
        if self._splined is None:
            if not self._xy_yaw:
                raise ValueError('an empty route has no poses; call through() first')
            samples = np.concatenate(self._xy_yaw)
            steps = np.linalg.norm(np.diff(samples[:, :2], axis=0), axis=1)
            travelled = np.concatenate([[0.0], np.cumsum(steps)])
            self._splined = CubicSpline(
                np.arange(len(samples)) / _RATE_HZ, np.column_stack([samples, travelled])
            )
        asked = np.asarray(time_s, np.float64)
        times = np.clip(asked, 0.0, self.duration_s)
        beyond = np.asarray(asked - times)[..., None]
        return np.asarray(self._splined(times) + beyond * self._splined(times, 1))

    def _append(self, leg: Array) -> None:
        if self._xy_yaw:  # keep yaw continuous across legs
            step = leg[0, 2] - self._xy_yaw[-1][-1, 2]
            leg = leg - [0.0, 0.0, 2 * np.pi * np.round(step / (2 * np.pi))]
        self._xy_yaw.append(leg)
        self._splined = None


def loop() -> Route:
    """About a minute around two blocks: one street again the same way, one in reverse.

    The second visits are 1.25 m beside the first (same way) and 3.5 m (reverse).
    """
    corners = [(-30, 0), (70, 0), (70, 55), (0, 55), (0, 0), (70, 0), (70, -45), (0, -45), (0, 55)]
    return Route(speed=13.0, corner_radius=9.0).through(
        corners, lane=[1.75] * 4 + [0.5] + [1.75] * 3
    )


def abrupt_u_turn() -> Route:
    """Drive out, turn by 180 degrees within a quarter of a second, drive back the same streets.

    No car turns so fast; what it stands for is any break of the constant-velocity guess: a robot
    that spins, a gap in the data, a blocked sensor.
    """
    out = [(0, 0), (90, 0), (90, 70), (150, 70)]
    back = [(150, 70), (130, 70), (90, 70), (90, 0), (-10, 0)]
    route = Route(speed=10.0).through(out).turn(np.pi, seconds=0.25)
    return route.through(back, lane=[-1.75, 1.75, 1.75, 1.75])


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _beside(centreline: Array, lanes: Array) -> Array:
    """Shift each stretch to its right and join neighbours where the shifted lines meet."""
    direction = np.diff(centreline, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    right = np.stack([direction[:, 1], -direction[:, 0]], axis=1) * lanes[:, None]
    points = [centreline[0] + right[0]]
    for i in range(1, len(centreline) - 1):
        cross = _cross(direction[i - 1], direction[i])
        if abs(cross) < 0.05:  # straight on: change lanes over ten metres
            points.append(centreline[i] + right[i - 1] - 5.0 * direction[i - 1])
            points.append(centreline[i] + right[i] + 5.0 * direction[i])
            continue
        gap = right[i] - right[i - 1]
        along = _cross(gap, direction[i]) / cross
        points.append(centreline[i] + right[i - 1] + along * direction[i - 1])
    points.append(centreline[-1] + right[-1])
    return np.array(points)


def _rounded(corners: Array, radius: float) -> Array:
    """Replace every corner by an arc; return points [N x 2] about 0.1 m apart."""
    pieces = []
    start = corners[0]
    for before, corner, after in zip(corners[:-2], corners[1:-1], corners[2:], strict=True):
        d_in, d_out = corner - before, after - corner
        l_in, l_out = np.linalg.norm(d_in), np.linalg.norm(d_out)
        d_in, d_out = d_in / l_in, d_out / l_out
        angle = float(np.arctan2(_cross(d_in, d_out), d_in @ d_out))
        cut = min(radius * np.tan(abs(angle) / 2), 0.45 * l_in, 0.45 * l_out)
        if abs(angle) < 1e-6:
            continue
        arc_radius = cut / np.tan(abs(angle) / 2)
        begin = corner - cut * d_in
        pieces.append(_line(start, begin))
        left = np.array([-d_in[1], d_in[0]]) * np.sign(angle)
        steps = max(2, int(np.ceil(arc_radius * abs(angle) / _PATH_STEP_M)))
        turned = np.abs(angle) * np.arange(steps) / steps
        pieces.append(
            begin
            + arc_radius * np.sin(turned)[:, None] * d_in
            + arc_radius * (1 - np.cos(turned))[:, None] * left
        )
        start = corner + cut * d_out
    pieces.append(_line(start, corners[-1]))
    return np.concatenate([*pieces, corners[-1:]])


def _with_run_up(path: Array, length: float = 60.0) -> Array:
    """Put a straight before the path to get up to speed on."""
    back = (path[0] - path[1]) / np.linalg.norm(path[0] - path[1])
    return np.concatenate([_line(path[0] + length * back, path[0]), path])


def _line(a: Array, b: Array) -> Array:
    steps = max(1, int(np.ceil(np.linalg.norm(b - a) / _PATH_STEP_M)))
    return a + (b - a) * (np.arange(steps) / steps)[:, None]


def _smoothed(path: Array) -> Array:
    """Take the jumps out of the curvature; the ends stay."""
    sigma = _SMOOTH_M / _PATH_STEP_M
    pad = int(4 * sigma)
    steps = np.arange(1, pad + 1)[:, None]
    before = path[0] - steps[::-1] * (path[1] - path[0])
    after = path[-1] + steps * (path[-1] - path[-2])
    padded = np.concatenate([before, path, after])
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0)[pad:-pad])


def _driven(path: Array, speed: float, lateral: float = 2.5, along: float = 2.5) -> Array:
    """Return x y yaw [N x 3] at 100 Hz of a car that keeps both acceleration limits (m/s^2)."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    tangent = np.gradient(path, s, axis=0)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    curvature = np.abs(np.gradient(yaw, s))
    v = np.minimum(speed, np.sqrt(lateral / np.maximum(curvature, 1e-6)))
    v[0] = v[-1] = 0.0
    for i in range(1, len(v)):
        v[i] = min(v[i], np.sqrt(v[i - 1] ** 2 + 2 * along * steps[i - 1]))
    for i in range(len(v) - 2, -1, -1):
        v[i] = min(v[i], np.sqrt(v[i + 1] ** 2 + 2 * along * steps[i]))
    t = np.concatenate([[0.0], np.cumsum(2 * steps / (v[1:] + v[:-1]))])
    still = 4 * _SMOOTH_S
    grid = np.arange(-still, t[-1] + still, 1 / _RATE_HZ)
    travelled = gaussian_filter1d(np.interp(grid, t, s), _SMOOTH_S * _RATE_HZ, mode='nearest')
    return np.asarray(CubicSpline(s, np.column_stack([path, yaw]))(travelled))
