"""Lay out the streets of a town: crossings, curves, dead ends and districts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lcd_common import se3

_STEP_M = 2.0
# How often a street is of a style: dense facades, gardens, trees without houses, halls, a square.
STYLES = ('urban', 'residential', 'avenue', 'industrial', 'open')
_STYLE_SHARES = (0.30, 0.36, 0.14, 0.12, 0.08)
_ESTATE_SHARE = 0.28  # of the streets of a town: its repetitive district
_SQUARES = 2


@dataclass(frozen=True)
class StreetEdge:
    """A street between two crossings.

    Attributes:
        i, j: nodes at its ends.
        centreline: [M x 2] from node i to node j, about 2 m apart, metres.
        style: what stands along it, one of STYLES or 'aliased'.
        half_width_m: from the centreline to the kerb.
    """

    i: int
    j: int
    centreline: se3.Array
    style: str
    half_width_m: float

    @property
    def length_m(self) -> float:
        """Length along the centreline."""
        return float(self._steps_m.sum())

    @cached_property
    def _steps_m(self) -> se3.Array:
        return np.asarray(np.linalg.norm(np.diff(self.centreline, axis=0), axis=1))

    @cached_property
    def _travelled_m(self) -> se3.Array:
        return np.concatenate([[0.0], np.cumsum(self._steps_m)])

    def at(self, s: float) -> tuple[se3.Array, se3.Array]:
        """Return the centreline's point [2] at `s` metres and the unit vector [2] along it."""
        line, travelled = self.centreline, self._travelled_m
        k = int(np.clip(np.searchsorted(travelled, s) - 1, 0, len(line) - 2))
        along = (line[k + 1] - line[k]) / self._steps_m[k]
        return line[k] + (s - travelled[k]) * along, along


@dataclass(frozen=True)
class StreetMap:
    """Streets as a connected graph.

    Attributes:
        nodes: [N x 2] crossings and ends, metres.
        edges: streets between them.
        squares: [S x 3] centre and radius of open squares at crossings, metres.
    """

    nodes: se3.Array
    edges: tuple[StreetEdge, ...]
    squares: se3.Array


def street_map(seed: int, style: str | None = None, size: int = 6) -> StreetMap:
    """Draw a map of about `size` x `size` crossings.

    Args:
        seed: of everything random.
        style: one for all streets ('aliased': a district of equal houses); None mixes STYLES.
        size: crossings each way.
    """
    rng = np.random.default_rng([seed, 11])
    block = rng.uniform(62.0, 105.0, 2)
    across = np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing='ij'), -1)
    jitter = 0.05 if style == 'aliased' else 0.24
    nodes = (across + rng.uniform(-jitter, jitter, across.shape)) * block
    # A town follows a valley or a shore: bend the whole grid.
    bend = 0.0 if style == 'aliased' else rng.uniform(-1.0, 1.0)
    nodes[..., 1] += bend * 25.0 * np.sin(nodes[..., 0] / nodes[..., 0].max() * np.pi)
    turned = rng.uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(turned), np.sin(turned)
    nodes = nodes.reshape(-1, 2) @ np.array([[c, s], [-s, c]])
    nodes -= nodes.mean(axis=0)
    index = np.arange(size * size).reshape(size, size)
    first, second = (
        [index[:-1].ravel(), index[:, :-1].ravel()],
        [index[1:].ravel(), index[:, 1:].ravel()],
    )
    diagonal = rng.integers(0, size - 1, (2, 2))
    first.append(index[tuple(diagonal.T)])
    second.append(index[tuple(diagonal.T + 1)])
    ends = np.concatenate(first).tolist(), np.concatenate(second).tolist()
    pairs: list[tuple[int, int]] = list(zip(*ends, strict=True))
    pairs = _thinned(pairs, len(nodes), rng)
    # What lies on one side of a line was built at one time: an estate of equal houses.
    own = np.random.default_rng([seed, 18])
    heading = own.uniform(0.0, 2.0 * np.pi)
    middles = np.array([(nodes[i] + nodes[j]) / 2 for i, j in pairs])
    side = middles @ [np.cos(heading), np.sin(heading)]
    estate = side < np.quantile(side, 0.0 if style else _ESTATE_SHARE)
    edges = []
    for (i, j), in_estate in zip(pairs, estate.tolist(), strict=True):
        curved = 0.0 if style == 'aliased' or rng.random() < 0.45 else rng.uniform(-0.14, 0.14)
        kind = style or str(rng.choice(STYLES, p=_STYLE_SHARES))
        half = float(rng.choice([3.6, 4.5, 5.3, 6.5], p=[0.25, 0.3, 0.3, 0.15]))
        if in_estate:
            curved, kind, half = 0.0, 'aliased', 4.5
        edges.append(
            StreetEdge(int(i), int(j), _centreline(nodes[i], nodes[j], curved), kind, half)
        )
    open_at = own.choice(len(nodes), 0 if style else _SQUARES, replace=False)
    radius = own.uniform(22.0, 34.0, (len(open_at), 1))
    return StreetMap(nodes, tuple(edges), np.hstack([nodes[open_at], radius]))


def _thinned(
    pairs: list[tuple[int, int]], nodes: int, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Leave out a fifth of the streets where the map stays in one piece; dead ends come about."""
    kept = list(dict.fromkeys(pairs))
    for pair in rng.permutation(len(kept))[: len(kept) // 5]:
        without = [p for p in kept if p is not None and p != pairs[pair]]
        if _pieces(without, nodes) == 1:
            kept = without
    return kept


def _pieces(pairs: list[tuple[int, int]], nodes: int) -> int:
    i, j = np.array(pairs).T
    return int(connected_components(coo_matrix((np.ones(len(i)), (i, j)), (nodes, nodes)))[0])


def _centreline(a: se3.Array, b: se3.Array, curved: float) -> se3.Array:
    """Return points from a to b on a bow that swings out by `curved` times the distance."""
    along = b - a
    length = float(np.linalg.norm(along))
    t = np.linspace(0.0, 1.0, max(3, round(length / _STEP_M)))[:, None]
    aside = np.array([-along[1], along[0]])
    return np.asarray(a + t * along + curved * np.sin(np.pi * t) ** 2 * aside)
