"""Choose which streets to drive, in which order, so that places are seen again as asked."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from bags.simulation.street_map import StreetMap
from lcd_common.settings import config, setting

_CANDIDATES = 320


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
        0.08, 'share of the crossings passed before on other streets', low=0.0, high=0.9
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
        turns_back: whether the street is left by a U-turn before its end.
    """

    edge: int
    forward: bool
    kind: str
    turns_back: bool = False


@dataclass(frozen=True)
class Itinerary:
    """Streets in the order driven, and how the shares came out (by length, by crossings)."""

    legs: tuple[Leg, ...]
    same_way: float
    reverse: float
    crossing: float


def itinerary(streets: StreetMap, settings: JourneyConfig, seed: int) -> Itinerary:
    """Return streets of at least the length asked for, shares as near to those asked as it finds.

    It draws many walks through the map and keeps the best; a map with fewer streets than the drive
    is long has more revisits than were asked for.
    """
    drawn = [
        _walk(streets, settings, np.random.default_rng([seed, 21, k])) for k in range(_CANDIDATES)
    ]
    return min(drawn, key=lambda one: _misfit(one, settings))


def _misfit(one: Itinerary, settings: JourneyConfig) -> float:
    turns = sum(leg.turns_back for leg in one.legs)  # people go round the block rather
    return (
        abs(one.same_way - settings.same_way)
        + abs(one.reverse - settings.reverse)
        + 0.5 * abs(one.crossing - settings.crossing)
        + 0.03 * turns
    )


def _walk(streets: StreetMap, settings: JourneyConfig, rng: np.random.Generator) -> Itinerary:
    lengths = [edge.length_m for edge in streets.edges]
    leaving = defaultdict(list)
    for number, edge in enumerate(streets.edges):
        leaving[edge.i].append((number, True, edge.j))
        leaving[edge.j].append((number, False, edge.i))
    node = int(rng.choice([n for n in leaving if len(leaving[n]) > 1] or list(leaving)))
    target = {'same_way': settings.same_way, 'reverse': settings.reverse}
    target['new'] = max(0.0, 1.0 - sum(target.values()))
    driven = dict.fromkeys(target, 0.0)
    done: dict[int, set[bool]] = defaultdict(set)
    used_at: dict[int, set[int]] = defaultdict(set)
    legs: list[Leg] = []
    crossed = 0
    # A little more than asked: crossings cut the corners.
    while sum(driven.values()) < 1.1 * settings.length + 60.0:
        options, weights = [], []
        for number, forward, end in leaving[node]:
            back = bool(legs) and number == legs[-1].edge
            kind = 'new'
            if done[number]:
                kind = 'same_way' if forward in done[number] else 'reverse'
            wanted = target[kind] - driven[kind] / max(200.0, sum(driven.values()))
            weight = float(np.exp(12.0 * wanted))
            if back and len(leaving[node]) > 1:
                weight *= 0.02
            elif kind == 'new' and legs and _is_crossed(used_at[node], number, legs[-1].edge):
                weight *= float(np.exp(12.0 * (settings.crossing - crossed / len(legs))))
            if len(leaving[end]) == 1:
                weight *= 0.4
            options.append((number, forward, end, kind, back))
            weights.append(weight)
        share = np.array(weights) / sum(weights)
        number, forward, end, kind, back = options[int(rng.choice(len(options), p=share))]
        if back:
            legs[-1] = Leg(legs[-1].edge, legs[-1].forward, legs[-1].kind, turns_back=True)
        elif legs:
            crossed += _is_crossed(used_at[node], number, legs[-1].edge)
            used_at[node] |= {number, legs[-1].edge}
        legs.append(Leg(number, forward, kind))
        driven[kind] += lengths[number]
        done[number].add(forward)
        node = end
    total = sum(driven.values())
    return Itinerary(
        tuple(legs),
        driven['same_way'] / total,
        driven['reverse'] / total,
        crossed / max(1, len(legs) - 1),
    )


def _is_crossed(used: set[int], one: int, other: int) -> bool:
    """Tell whether a crossing was passed before, but on neither of two streets."""
    return bool(used) and one not in used and other not in used
