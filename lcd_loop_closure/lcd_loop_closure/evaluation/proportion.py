"""Say how sure a share of successes is."""

from dataclasses import dataclass

import numpy as np

_Z95 = 1.959963984540054


@dataclass(frozen=True)
class Proportion:
    """A share with its 95 % Wilson score interval (Wilson, JASA 1927).

    Attributes:
        successes, trials: counted.
    """

    successes: int
    trials: int

    @property
    def share(self) -> float | None:
        """Share of successes; None without trials."""
        return self.successes / self.trials if self.trials else None

    @property
    def interval(self) -> list[float] | None:
        """Ends of the interval; None without trials."""
        if not self.trials:
            return None
        n, p, z2 = self.trials, self.successes / self.trials, _Z95**2
        middle = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = _Z95 * np.sqrt(p * (1 - p) / n + z2 / (4 * n * n)) / (1 + z2 / n)
        return [max(0.0, float(middle - half)), min(1.0, float(middle + half))]
