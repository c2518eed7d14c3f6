"""Notice that inputs are no longer like those of the calibration, and withdraw its guarantee."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcd_common.errors import DataError, MapError
from lcd_common.settings import config, setting

# Bets of k p^(k - 1) on each p-value, from "tiny" to "as it should be" (k = 1 stakes nothing).
_BETS = np.array([0.1, 0.3, 0.6, 1.0])
_MOST = 1000


@config
class DriftConfig:
    """How much evidence is needed."""

    limit: float = setting(
        100.0, 'evidence that raises the alarm; a false one comes once in so many blocks', low=2.0
    )
    jump: float = setting(0.01, 'share of the stake that changes its bet', low=0.0, high=1.0)


@dataclass(frozen=True)
class DriftReference:
    """Mean uncertainties of blocks of the calibration, rising.

    Attributes:
        means: [B].
        block: queries of a block.
    """

    means: NDArray[np.float64]
    block: int

    @staticmethod
    def fit(uncertainty: Iterable[ArrayLike], block: int = 5) -> 'DriftReference':
        """Take the uncertainties of calibration runs.

        Args:
            uncertainty: [N] of each run, in the order of driving.
            block: successive queries that are averaged, because neighbours are alike.

        Raises:
            DataError: no run is as long as a block.
        """
        means: list[NDArray[np.float64]] = []
        for run in uncertainty:
            values = np.asarray(run, np.float64)
            values = values[np.isfinite(values)]
            whole = len(values) // block * block
            means.append(values[:whole].reshape(-1, block).mean(1))
        every = np.sort(np.concatenate([*means, np.empty(0)]))
        if not len(every):
            raise DataError(f'no calibration run has {block} queries: drift cannot be told')
        if len(every) > _MOST:
            # A coarser set of quantiles stands for it; the smallest p-value is then 1 / 1001.
            every = np.quantile(every, (np.arange(_MOST) + 0.5) / _MOST)
        return DriftReference(every, block)

    def p_value(self, mean: float) -> float:
        """Return the conformal p-value of a block: small when it is more uncertain than most.

        Equal ones count fully, which can only delay an alarm.
        """
        if not np.isfinite(mean):
            return 1.0 / (len(self.means) + 1)
        as_high = len(self.means) - np.searchsorted(self.means, mean, side='left')
        return float(as_high + 1) / (len(self.means) + 1)

    def plain(self) -> dict[str, Any]:
        """Return the reference as JSON has it."""
        return {'block': self.block, 'means': self.means.tolist()}

    @staticmethod
    def from_plain(plain: Mapping[str, Any]) -> 'DriftReference':
        """Return what `plain` gave; raises MapError when it is none."""
        try:
            means, block = np.array(plain['means'], np.float64), int(plain['block'])
        except (KeyError, TypeError, ValueError) as error:
            raise MapError(f'no reference of drift: {error!r}') from None
        if means.ndim != 1 or not len(means) or block < 1:
            raise MapError('a reference of drift without blocks')
        return DriftReference(np.sort(means), block)


@dataclass(frozen=True)
class Drift:
    """What is known after a query.

    Attributes:
        alarm: inputs are not like those of the calibration; its guarantee does not hold.
        evidence: gain of the bets; 1 says nothing, the limit raises the alarm.
        p_value: of the last whole block; None before the first.
    """

    alarm: bool
    evidence: float
    p_value: float | None


class DriftAlarm:
    """Bet against the calibration with every block, and raise the alarm after winning a lot.

    A conformal test martingale (Vovk et al., "Retrain or not retrain", COPA 2021; simple jumper):
    while blocks are exchangeable with the calibration's, nobody gets rich by such bets. A stake
    below 1 is filled up, so that a long good drive does not delay the alarm; false alarms then come
    on average no sooner than every `limit` blocks. The alarm ends when most of the evidence is lost
    again: when it falls below the root of the limit.
    """

    def __init__(self, reference: DriftReference, settings: DriftConfig | None = None) -> None:
        self.reference = reference
        self.settings = settings or DriftConfig()
        self.reset()

    def reset(self) -> None:
        """Forget all evidence."""
        self._block: list[float] = []
        self._stakes = np.full(len(_BETS), 1.0 / len(_BETS))
        self.drift = Drift(False, 1.0, None)

    def update(self, uncertainty: float) -> Drift:
        """Take the uncertainty of the next query, in the order of driving."""
        self._block.append(uncertainty)
        if len(self._block) == self.reference.block:
            self._bet(self.reference.p_value(float(np.mean(self._block))))
            self._block = []
        return self.drift

    def _bet(self, p_value: float) -> None:
        jump, limit = self.settings.jump, self.settings.limit
        total = float(self._stakes.sum())
        stakes = (1.0 - jump) * self._stakes + jump * total / len(_BETS)
        stakes = stakes * _BETS * p_value ** (_BETS - 1.0)
        evidence = float(stakes.sum())
        if evidence < 1.0:
            stakes, evidence = np.full(len(_BETS), 1.0 / len(_BETS)), 1.0
        # Twice the limit is enough: more would only make the alarm outlast its cause.
        top = min(evidence, 2.0 * limit)
        self._stakes = stakes * (top / evidence)
        alarm = top >= (np.sqrt(limit) if self.drift.alarm else limit)
        self.drift = Drift(bool(alarm), top, p_value)
