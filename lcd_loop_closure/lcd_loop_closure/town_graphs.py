"""Invent pose graphs of drives through a town, with true loops and wrong ones.

A vehicle takes random turns in a grid of streets, so that it comes back to places the same way and
the reverse way. Odometry drifts as KISS-ICP's on KITTI (about 0.5 m in 100 m): white noise that its
covariance tells, and a constant turn and climb that it does not. For tests and benchmarks of the
back-end, where poses alone are enough.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint

_PERIOD_NS = 200_000_000
_START_NS = 1_600_000_000_000_000_000


@config
class TownGraphConfig:
    """The town, the drive and the noise."""

    keyframes: int = setting(1000, 'length of the drive', low=2)
    spacing: float = setting(2.0, 'distance between keyframes', unit='m', low=0.1)
    streets: int = setting(6, 'streets in each direction', low=2)
    block: float = setting(80.0, 'distance between streets', unit='m', low=20.0)
    corner: float = setting(8.0, 'radius of the turns', unit='m', low=1.0, high=9.9)
    odometry_translation: float = setting(0.01, 'white noise', unit='m/sqrt(m)', low=0.0)
    odometry_rotation: float = setting(7e-4, 'white noise', unit='rad/sqrt(m)', low=0.0)
    odometry_bias: float = setting(3e-5, 'constant turn, by seed', unit='rad/m', low=0.0)
    loop_translation: float = setting(0.05, 'registration noise', unit='m', low=0.0)
    loop_rotation: float = setting(5e-3, 'registration noise', unit='rad', low=0.0)
    loop_radius: float = setting(4.0, 'farthest pair that is registered', unit='m', low=0.1)
    loop_share: float = setting(0.5, 'share of keyframes whose loop is found', low=0.0, high=1.0)
    minimum_gap: int = setting(50, 'keyframes between the two of a loop', low=2)
    lane: float = setting(1.5, 'drives on the right of the street by this', unit='m', low=0.0)


@dataclass(frozen=True)
class TownGraph:
    """A drive: truth, what odometry made of it, and its loops.

    Attributes:
        T_world_base: [N x 4 x 4] truth; the first is the identity.
        motions: [N x 4 x 4] odometry's T_previous_this; the identity in row 0.
        motion_covariances: [N x 6 x 6] as odometry tells them (the white noise alone).
        loops: measured loops, by query id.
    """

    T_world_base: se3.Array
    motions: se3.Array
    motion_covariances: se3.Array
    loops: tuple[LoopConstraint, ...]

    def __len__(self) -> int:
        return len(self.T_world_base)

    @property
    def T_odom_base(self) -> se3.Array:
        """Chained odometry [N x 4 x 4]."""
        return chain(self.motions)

    def with_loops(self, more: tuple[LoopConstraint, ...]) -> 'TownGraph':
        """Return the graph with further loops, by query; on the same pair the old one stays."""
        taken = {(loop.match_id, loop.query_id) for loop in self.loops}
        new = [loop for loop in more if (loop.match_id, loop.query_id) not in taken]
        ordered = sorted([*self.loops, *new], key=lambda loop: (loop.query_id, loop.match_id))
        return replace(self, loops=tuple(ordered))

    def with_broken_link(self, row: int, T_wrong_right: se3.Array) -> 'TownGraph':
        """Return the graph whose odometry erred in one link by a transform and did not notice."""
        motions = self.motions.copy()
        motions[row] = motions[row] @ T_wrong_right
        return replace(self, motions=motions)

    def keyframes(self) -> Iterator[Keyframe]:
        """Yield the drive as the pose graph would receive it, without points."""
        nothing = PointCloud(np.zeros((0, 3), np.float32))
        for i, T in enumerate(self.T_odom_base):
            covariance = self.motion_covariances[i] if i else None
            yield Keyframe(i, stamp_ns(i), T, self.motions[i], covariance, nothing)


def town_graph(settings: TownGraphConfig, seed: int) -> TownGraph:
    """Drive through a town; the same seed drives the same way with the same noise."""
    rng = np.random.default_rng(seed)
    T = _drive(settings, rng)
    motions, covariances = _odometry(settings, T, rng)
    return TownGraph(T, motions, covariances, tuple(_true_loops(settings, T, rng)))


def random_false_loops(
    graph: TownGraph, count: int, seed: int, min_distance: float = 15.0
) -> tuple[LoopConstraint, ...]:
    """Invent loops between places that lie apart, each claiming that they are the same place."""
    rng = np.random.default_rng(seed)
    loops: list[LoopConstraint] = []
    positions = graph.T_world_base[:, :3, 3]
    while len(loops) < count:
        i, j = sorted(int(v) for v in rng.integers(0, len(graph), 2))
        if j - i < 50 or np.linalg.norm(positions[i] - positions[j]) < min_distance:
            continue
        yaw = rng.choice([0.0, np.pi]) + rng.normal(0, 0.1)
        T_match_query = se3.exp([*rng.normal(0, [1.5, 1.5, 0.1]), 0, 0, yaw])
        loops.append(loop_between(i, j, T_match_query, method='false'))
    return tuple(loops)


def aliased_false_loops(
    graph: TownGraph, count: int, seed: int, min_distance: float = 15.0
) -> tuple[LoopConstraint, ...]:
    """Invent loops between two stretches that agree with each other, as look-alike streets."""
    rng = np.random.default_rng(seed)
    T = graph.T_world_base
    while True:
        i, j = sorted(int(v) for v in rng.integers(0, len(graph) - count, 2))
        apart = np.linalg.norm(T[i : i + count, :3, 3] - T[j : j + count, :3, 3], axis=1)
        if j - i >= 50 + count and apart.min() >= min_distance:
            break
    T_i_j = se3.exp([*rng.normal(0, [1.0, 1.0, 0.1]), 0, 0, rng.normal(0, 0.1)])
    T_wrong = T[i] @ T_i_j @ se3.inverse(T[j])
    noise = _noise(rng, count, 0.05, 5e-3)
    measured = se3.inverse(T[i : i + count]) @ T_wrong @ T[j : j + count] @ noise
    return tuple(loop_between(i + k, j + k, measured[k], method='aliased') for k in range(count))


def loop_between(
    match_id: int, query_id: int, T_match_query: se3.Array, method: str = 'true'
) -> LoopConstraint:
    """Return an accepted loop as registration would report it; its covariance is too sure."""
    return LoopConstraint(
        match_id,
        query_id,
        stamp_ns(match_id),
        stamp_ns(query_id),
        T_match_query,
        diagonal(0.02, 2e-3),
        method=method,
    )


def stamp_ns(row: int) -> int:
    """Return the stamp of a keyframe of a made-up drive."""
    return _START_NS + row * _PERIOD_NS


def chain(motions: se3.Array) -> se3.Array:
    """Multiply motions [N x 4 x 4] up to poses; row 0 is the first pose."""
    poses = np.empty_like(motions)
    poses[0] = motions[0]
    for i in range(1, len(motions)):
        poses[i] = poses[i - 1] @ motions[i]
    return poses


def _noise(rng: np.random.Generator, count: int, metres: float, radians: float) -> se3.Array:
    xi = rng.normal(size=(count, 6)) * np.repeat([metres, radians], 3)
    return np.array([se3.exp(x) for x in xi]).reshape(-1, 4, 4)


def _drive(settings: TownGraphConfig, rng: np.random.Generator) -> se3.Array:
    points = _driven_line(settings, rng)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    s = np.arange(settings.keyframes) * settings.spacing
    xy = np.stack([np.interp(s, along, points[:, k]) for k in range(2)], axis=1)
    ahead = np.stack([np.interp(s + 0.5, along, points[:, k]) for k in range(2)], axis=1)
    behind = np.stack([np.interp(s - 0.5, along, points[:, k]) for k in range(2)], axis=1)
    course = ahead - behind
    yaw = np.arctan2(course[:, 1], course[:, 0]) + rng.normal(0, 0.02, len(s))
    xy += rng.normal(0, 0.2, xy.shape)
    T = np.tile(np.eye(4), (len(s), 1, 1))
    for i in range(len(s)):
        T[i] = se3.rotation_z(yaw[i])
        hills = 3.0 * np.sin(xy[i, 0] / 90.0) + 2.0 * np.cos(xy[i, 1] / 70.0)
        T[i, :3, 3] = [*xy[i], hills]
    return se3.inverse(T[0]) @ T


def _driven_line(settings: TownGraphConfig, rng: np.random.Generator) -> np.ndarray:
    """Return a dense line [K x 2] that keeps right and takes the corners in arcs."""
    headings = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    length = settings.keyframes * settings.spacing + 2 * settings.block
    node, heading = rng.integers(0, settings.streets, 2), int(rng.integers(4))
    points: list[np.ndarray] = []
    driven = 0.0
    while driven < length:
        inside = [
            h
            for h in (heading, (heading + 1) % 4, (heading - 1) % 4)
            if ((node + headings[h] >= 0) & (node + headings[h] < settings.streets)).all()
        ]
        heading = int(rng.choice(inside)) if inside else (heading + 2) % 4
        forward = headings[heading]
        right = np.array([forward[1], -forward[0]])
        start = node * settings.block + forward * settings.corner + right * settings.lane
        end = (node + forward) * settings.block - forward * settings.corner + right * settings.lane
        node = node + forward
        if points:
            points.extend(_corner(points[-2], points[-1], start, start + forward))
        points.extend([start, end])
        driven += settings.block
    return np.array(points)


def _corner(
    before: np.ndarray, start: np.ndarray, end: np.ndarray, after: np.ndarray
) -> list[np.ndarray]:
    """Return points of a cubic that leaves and arrives along the streets."""
    reach = float(np.linalg.norm(end - start))
    leave = (start - before) / max(float(np.linalg.norm(start - before)), 1e-9) * reach
    arrive = (after - end) / max(float(np.linalg.norm(after - end)), 1e-9) * reach
    t = np.linspace(0, 1, 12)[1:-1, None]
    line = (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * leave
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * arrive
    )
    return list(line)


def _odometry(
    settings: TownGraphConfig, T: se3.Array, rng: np.random.Generator
) -> tuple[se3.Array, se3.Array]:
    motions = np.tile(np.eye(4), (len(T), 1, 1))
    motions[1:] = se3.inverse(T[:-1]) @ T[1:]
    root = np.sqrt(settings.spacing)
    noise = _noise(
        rng,
        len(T) - 1,
        settings.odometry_translation * root,
        settings.odometry_rotation * root,
    )
    # The constant part is what makes real odometry worse than its covariance says.
    turn = rng.normal(0, settings.odometry_bias, 3) * settings.spacing * [0.2, 1.0, 1.0]
    motions[1:] = motions[1:] @ se3.exp([0, 0, 0, *turn]) @ noise
    told = diagonal(
        max(settings.odometry_translation * root, 1e-6),
        max(settings.odometry_rotation * root, 1e-8),
    )
    return motions, np.tile(told, (len(T), 1, 1))


def _true_loops(
    settings: TownGraphConfig, T: se3.Array, rng: np.random.Generator
) -> Iterator[LoopConstraint]:
    positions = T[:, :3, 3]
    tree = cKDTree(positions)
    noise = _noise(rng, len(T), settings.loop_translation, settings.loop_rotation)
    found = rng.random(len(T)) < settings.loop_share
    for j in range(len(T)):
        near = tree.query_ball_point(positions[j], settings.loop_radius)
        old = [i for i in near if j - i >= settings.minimum_gap]
        if not old or not found[j]:
            continue
        i = min(old, key=lambda k: float(np.linalg.norm(positions[k] - positions[j])))
        yield loop_between(i, j, se3.inverse(T[i]) @ T[j] @ noise[j])
