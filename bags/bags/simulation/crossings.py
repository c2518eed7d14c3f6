"""Which streets lie across from each other where they meet."""

from collections import defaultdict
from collections.abc import Collection

import numpy as np

from bags.simulation.lane import corner_m
from bags.simulation.street_map import StreetMap

Pass = tuple[int, int]  # numbers of the streets by which a car came to a crossing and left it


class Crossings:
    """The crossings of a map, each with its streets in the order in which they lie round it."""

    def __init__(self, streets: StreetMap) -> None:
        """Sort the streets of every crossing by their direction there."""
        angle: dict[int, dict[int, float]] = defaultdict(dict)
        for number, edge in enumerate(streets.edges):
            cut = corner_m(edge)
            _, away = edge.at(cut)
            _, towards = edge.at(edge.length_m - cut)
            angle[edge.i][number] = float(np.arctan2(away[1], away[0]))
            angle[edge.j][number] = float(np.arctan2(-towards[1], -towards[0]))
        self._round = {node: sorted(at, key=at.__getitem__) for node, at in angle.items()}
        self._place = {
            (node, number): k
            for node, around in self._round.items()
            for k, number in enumerate(around)
        }

    def across(self, node: int, number: int) -> int | None:
        """Return the street across from one; None where fewer than four streets meet."""
        around = self._round[node]
        if len(around) < 4:
            return None
        return around[(self._place[node, number] + len(around) // 2) % len(around)]

    def meets(self, node: int, one: int, other: int, before: Collection[Pass]) -> bool:
        """Tell whether the way from one street to another cuts a way driven before.

        It does not where one of both streets was driven before at this crossing: such a place is
        seen again along the street. Ways round opposite corners do not cut either.
        """
        if one == other or any(one in each or other in each for each in before):
            return False
        low, high = sorted((self._place[node, one], self._place[node, other]))
        return any(
            (low < self._place[node, a] < high) != (low < self._place[node, b] < high)
            for a, b in before
        )
