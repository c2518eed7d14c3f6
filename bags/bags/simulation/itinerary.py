"""Choose which streets to drive, in which order, so that places are seen again as asked."""

from bisect import bisect
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from math import exp

import numpy as np

from bags.simulation.crossings import Crossings, Pass
from bags.simulation.lane import LaneLengths
from bags.simulation.street_map import StreetMap
from lcd_common.settings import config, setting

_CANDIDATES = 640
_SPARE_SHARE, _SPARE_M = 0.01, 15.0  # planned besides: lanes differ from run to run
_EAGER, _EAGER_TO_CROSS = 12.0, 30.0  # how strongly a walk tends to what it lacks


@config
class JourneyConfig:
    """What a drive is like."""

    length: float = setting(1500.0, 'of the drive', unit='m', low=50.0, high=50_000.0)
    same_way: float = setting(
        0.2, 'share of it on streets driven before the same way', low=0.0, high=0.9
    )
    reverse: float = setting(
        0.1, 'share of it on streets driven before the other way only', low=0.0, high=0.9
    )
    crossing: float = setting(
        0.08,
        'share of the crossings passed before on other streets, right across; four streets meet '
        'at few crossings of a town, so about 0.1 is the most that comes out',
        low=0.0,
        high=0.2,
    )
    lateral: float = setting(
        1.0, 'largest shift to the side when a street is driven again', unit='m', low=0.0, high=3.0
    )
    speed: float = setting(11.0, 'top speed', unit='m/s', low=1.0, high=30.0)
    stops: float = setting(0.15, 'share of the crossings where the car stops', low=0.0, high=1.0)


@dataclass(frozen=True)
class Leg:
    """One street of an itinerary.

    Attributes:
        edge: number of the street in the map.
        forward: whether it is driven from node i to node j.
        kind: 'new', 'same_way' or 'reverse', by what was driven before.
        crosses: whether a way driven before is cut at the crossing where the street begins.
        turns_back: whether the street is left by a U-turn before its end.
    """

    edge: int
    forward: bool
    kind: str
    crosses: bool = False
    turns_back: bool = False


@dataclass(frozen=True)
class Itinerary:
    """Streets in the order driven, and how the shares of revisits came out.

    Attributes:
        legs: the streets.
        metres: driven on each and round the corner behind it; 0 where the drive ends before.
    """

    legs: tuple[Leg, ...]
    metres: tuple[float, ...]

    @property
    def same_way(self) -> float:
        """Share of the metres on streets driven before the same way."""
        return self._share('same_way')

    @property
    def reverse(self) -> float:
        """Share of the metres on streets driven before the other way only."""
        return self._share('reverse')

    @property
    def crossing(self) -> float:
        """Share of the crossings that were passed before on other streets, right across."""
        entered = [leg.crosses for leg, m in zip(self.legs, self.metres, strict=True) if m][1:]
        return sum(entered) / max(1, len(entered))

    def driven(self, metres: Sequence[float]) -> 'Itinerary':
        """Return the legs that a drive came to, with the metres [K] that it drove on each."""
        return Itinerary(self.legs[: len(metres)], tuple(metres))

    def _share(self, kind: str) -> float:
        of_kind = (m for leg, m in zip(self.legs, self.metres, strict=True) if leg.kind == kind)
        return sum(of_kind) / sum(self.metres)


def itinerary(streets: StreetMap, settings: JourneyConfig, seed: int) -> Itinerary:
    """Return streets for the length asked for, shares as near to those asked as it finds.

    It draws many walks through the map and keeps the best; a map with fewer streets than the drive
    is long has more revisits than were asked for. The metres are those of the middle of the lane;
    a street or two at the end are spare.
    """
    walker = _Walker(streets, settings)
    drawn = (walker.walk(np.random.default_rng([seed, 21, k])) for k in range(_CANDIDATES))
    return min(drawn, key=lambda one: _misfit(one, settings))


def _misfit(one: Itinerary, settings: JourneyConfig) -> float:
    turns = sum(leg.turns_back for leg in one.legs)  # people go round the block rather
    return (
        abs(one.same_way - settings.same_way)
        + abs(one.reverse - settings.reverse)
        + abs(one.crossing - settings.crossing)
        + 0.03 * turns
    )


class _Walker:
    """Draws walks through a map that tend to the shares asked for."""

    def __init__(self, streets: StreetMap, settings: JourneyConfig) -> None:
        self._settings = settings
        self._lengths = LaneLengths(streets)
        self._crossings = Crossings(streets)
        self._leaving: dict[int, list[tuple[int, bool, int]]] = defaultdict(list)
        for number, edge in enumerate(streets.edges):
            self._leaving[edge.i].append((number, True, edge.j))
            self._leaving[edge.j].append((number, False, edge.i))
        self._starts = [n for n in self._leaving if len(self._leaving[n]) > 1]
        self._starts = self._starts or list(self._leaving)
        new = max(0.0, 1.0 - settings.same_way - settings.reverse)
        self._target = {'same_way': settings.same_way, 'reverse': settings.reverse, 'new': new}

    def walk(self, rng: np.random.Generator) -> Itinerary:
        """Return streets for the length of the drive and a little more."""
        node = self._starts[int(rng.integers(len(self._starts)))]
        length = self._settings.length
        driven = dict.fromkeys(self._target, 0.0)
        done: dict[int, set[bool]] = defaultdict(set)
        passes: dict[int, list[Pass]] = defaultdict(list)
        legs: list[Leg] = []
        metres: list[float] = []
        total, crossed = 0.0, 0
        while total < (1.0 + _SPARE_SHARE) * length + _SPARE_M:
            last = legs[-1] if legs else None
            lack = self._settings.crossing - crossed / max(1, len(legs))
            options, weights = [], []
            for number, forward, end in self._leaving[node]:
                back = last is not None and number == last.edge
                kind, crosses = 'new', False
                if done[number]:
                    kind = 'same_way' if forward in done[number] else 'reverse'
                weight = exp(_EAGER * (self._target[kind] - driven[kind] / max(200.0, total)))
                if back and len(self._leaving[node]) > 1:
                    weight *= 0.02
                elif kind == 'new' and last is not None:
                    crosses = self._crossings.meets(node, last.edge, number, passes[node])
                    if crosses or self._leads_across(node, last.edge, number, end, passes):
                        weight *= exp(_EAGER_TO_CROSS * lack)
                if len(self._leaving[end]) == 1:
                    weight *= 0.4
                options.append((number, forward, kind, crosses, end))
                weights.append(weight)
            upto = list(accumulate(weights))
            chosen = bisect(upto, upto[-1] * rng.random(), hi=len(upto) - 1)
            number, forward, kind, crosses, end = options[chosen]
            leg = Leg(number, forward, kind, crosses)
            if last is not None:
                turn = self._lengths.turn_m(last.edge, last.forward, leg.edge, leg.forward)
                metres[-1] += turn
                driven[last.kind] += turn
                total += turn
                if leg.edge == last.edge:
                    legs[-1] = replace(last, turns_back=True)
                else:
                    crossed += leg.crosses
                    passes[node].append((last.edge, leg.edge))
            legs.append(leg)
            metres.append(self._lengths.straight_m[leg.edge])
            driven[leg.kind] += metres[-1]
            total += metres[-1]
            done[leg.edge].add(leg.forward)
            node = end
        ends = np.minimum(np.cumsum(metres), length)
        return Itinerary(tuple(legs), tuple(np.diff(ends, prepend=0.0).tolist()))

    def _leads_across(
        self, node: int, last: int, number: int, end: int, passes: dict[int, list[Pass]]
    ) -> bool:
        """Tell whether a street leads to a way that it can cut, or leaves one that can be cut."""
        onward = self._crossings.across(end, number)
        if onward is not None and self._crossings.meets(end, number, onward, passes[end]):
            return True
        return not passes[node] and self._crossings.across(node, last) == number
