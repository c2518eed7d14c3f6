"""What stands along a street of each style: how dense, how far back, how tall."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class HouseRow:
    """What the houses on one side of a street have in common, metres.

    They were built in one go along one building line; most streets look the same for a while.
    Where they are `alike`, one is the copy of the other.
    """

    width: float
    depth: float
    setback: float
    storeys: int
    alike: bool

    def house(self, rng: np.random.Generator) -> tuple[float, float, float]:
        """Draw width, depth and setback of one of them."""
        if self.alike:
            return self.width, self.depth, self.setback
        off_line = 0.3 if rng.random() < 0.85 else 2.0
        return (
            self.width * float(rng.uniform(0.85, 1.2)),
            self.depth * float(rng.uniform(0.85, 1.15)),
            max(self.setback + float(rng.uniform(0.0, off_line)), 0.2),
        )


@dataclass(frozen=True)
class Streetscape:
    """Spacing and sizes, metres; ranges are (least, most).

    Attributes:
        house_gap: between neighbours, or None for no houses.
        house_width, house_depth, setback: of houses; setback from the land behind the kerb.
        storeys: (least, most).
        tree_gap, hedge_gap, shrub_gap, lamp_gap, car_gap: between things of a row; None for none.
        second_row: houses behind the houses.
        hall: long, low, windowless buildings instead of houses.
    """

    house_gap: tuple[float, float] | None
    house_width: tuple[float, float] = (7.0, 21.0)
    house_depth: tuple[float, float] = (7.0, 13.0)
    setback: tuple[float, float] = (0.5, 6.5)
    storeys: tuple[int, int] = (1, 4)
    tree_gap: tuple[float, float] | None = (5.0, 22.0)
    hedge_gap: tuple[float, float] | None = (2.0, 12.0)
    shrub_gap: tuple[float, float] | None = (1.5, 9.0)
    lamp_gap: tuple[float, float] | None = (17.0, 31.0)
    car_gap: tuple[float, float] | None = (0.7, 15.0)
    second_row: bool = True
    hall: bool = False

    def row(self, rng: np.random.Generator) -> HouseRow:
        """Draw what the houses on one side of a street have in common."""
        return HouseRow(
            float(rng.uniform(*self.house_width)),
            float(rng.uniform(*self.house_depth)),
            float(rng.uniform(*self.setback)),
            int(rng.integers(self.storeys[0], self.storeys[1] + 1)),
            alike=self.house_width[0] == self.house_width[1],
        )


STREETSCAPES = {
    'urban': Streetscape(
        house_gap=(0.0, 1.0), setback=(0.2, 1.2), storeys=(3, 6), tree_gap=(12.0, 45.0),
        hedge_gap=None, shrub_gap=(8.0, 40.0), car_gap=(0.6, 6.0),
    ),
    'residential': Streetscape(
        house_gap=(2.0, 7.0), house_width=(8.0, 16.0), setback=(1.5, 6.5), storeys=(1, 3),
        hedge_gap=(0.5, 4.0),
    ),
    'avenue': Streetscape(
        house_gap=(25.0, 70.0), setback=(10.0, 18.0), tree_gap=(6.0, 9.0), hedge_gap=(5.0, 30.0),
        car_gap=(6.0, 40.0), second_row=False,
    ),
    'industrial': Streetscape(
        house_gap=(6.0, 25.0), house_width=(20.0, 48.0), house_depth=(14.0, 26.0),
        setback=(4.0, 14.0), tree_gap=(20.0, 60.0), hedge_gap=(1.0, 6.0), car_gap=(3.0, 30.0),
        second_row=False, hall=True,
    ),
    'open': Streetscape(
        house_gap=None, tree_gap=(18.0, 60.0), hedge_gap=(15.0, 50.0), lamp_gap=(22.0, 40.0),
        car_gap=(10.0, 50.0), second_row=False,
    ),
    # The same house, tree and lamp again and again, as in an estate.
    'aliased': Streetscape(
        house_gap=(4.0, 4.0), house_width=(10.0, 10.0), house_depth=(9.0, 9.0), setback=(3.0, 3.0),
        storeys=(2, 2), tree_gap=(14.0, 14.0), hedge_gap=None, shrub_gap=None,
        lamp_gap=(28.0, 28.0),
        car_gap=(2.0, 20.0), second_row=False,
    ),
}  # fmt: skip
