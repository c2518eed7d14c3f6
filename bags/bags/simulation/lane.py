"""Where cars drive on a street, and how far it is along it and round its corners."""

import numpy as np

from bags.simulation.street_map import StreetEdge, StreetMap

CORNER_M = 7.5  # streets are left this far before their crossings, past the last parked cars
_HALF_CAR_M = 0.95


def lane_m(edge: StreetEdge) -> float:
    """Return how far right of the centreline cars drive: clear of those parked at the kerb."""
    return float(np.clip(edge.half_width_m - 3.2, 1.3, 1.75))


def farthest_right_m(edge: StreetEdge) -> float:
    """Return how far right a car may drive: nobody parks in streets narrower than 8 m."""
    parked = 2.3 if edge.half_width_m >= 4.0 else 0.3
    return max(edge.half_width_m - parked - _HALF_CAR_M, 1.2)


def corner_m(edge: StreetEdge) -> float:
    """Return how far before its ends a street is left."""
    return min(CORNER_M, 0.35 * edge.length_m)


class LaneLengths:
    """The way that a car drives on the streets of a map: straight on, and round each corner."""

    def __init__(self, streets: StreetMap) -> None:
        """Measure the streets; corners are measured when they are first asked for."""
        self._edges = streets.edges
        self.straight_m = [edge.length_m - 2.0 * corner_m(edge) for edge in streets.edges]
        self._turns: dict[tuple[int, bool, int, bool], float] = {}

    def turn_m(self, edge: int, forward: bool, following: int, onward: bool) -> float:
        """Return the length of the turn from the end of one street into another, or back into it.

        Args:
            edge: number of the street that is left.
            forward: whether it was driven from node i to node j.
            following: number of the street that is entered.
            onward: whether that one will be driven from node i to node j.
        """
        key = (edge, forward, following, onward)
        if key not in self._turns:
            self._turns[key] = self._turn_m(*key)
        return self._turns[key]

    def _turn_m(self, edge: int, forward: bool, following: int, onward: bool) -> float:
        begin, d_in = _lane_at(self._edges[edge], forward, begins=False)
        end, d_out = _lane_at(self._edges[following], onward, begins=True)
        chord = float(np.linalg.norm(end - begin))
        half = 0.5 * max(float(np.arccos(np.clip(d_in @ d_out, -1.0, 1.0))), 1e-3)
        return chord * half / np.sin(half)  # of a circle's arc


def _lane_at(edge: StreetEdge, forward: bool, begins: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the lane's point [2] where a street is entered or left, and the heading [2] there."""
    cut = corner_m(edge)
    at, along = edge.at(cut if forward == begins else edge.length_m - cut)
    along = along if forward else -along
    return at + lane_m(edge) * np.array([along[1], -along[0]]), along
