"""Sum up how well pairs were registered (thesis section 3.3.4)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.evaluation.proportion import Proportion

# A registration counts when it is off by no more (thesis section 3.3.4).
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0


@dataclass(frozen=True)
class RegistrationErrors:
    """Errors of every pair; NaN where a method gave no answer.

    Attributes:
        te_m: [P] translation error.
        re_deg: [P] rotation error, the whole angle.
        yaw_deg: [P] error of the heading alone.
        prepare_ms, register_ms: mean time for a cloud and for a pair.
        yaw_only: the method tells heading alone: translation does not count.
    """

    te_m: NDArray[np.float64]
    re_deg: NDArray[np.float64]
    yaw_deg: NDArray[np.float64]
    prepare_ms: float | None = None
    register_ms: float | None = None
    yaw_only: bool = False

    def __len__(self) -> int:
        return len(self.te_m)

    @property
    def success(self) -> NDArray[np.bool_]:
        """Which pairs count as registered, heading alone, as in the authors' evaluation."""
        return (self.yaw_only | (self.te_m <= SUCCESS_M)) & (self.yaw_deg <= SUCCESS_DEG)

    @property
    def success_full(self) -> NDArray[np.bool_]:
        """Which pairs count as registered by the whole rotation."""
        return (self.te_m <= SUCCESS_M) & (self.re_deg <= SUCCESS_DEG)

    def select(self, mask: NDArray[np.bool_]) -> 'RegistrationErrors':
        """Return the errors of some pairs."""
        return replace(
            self, te_m=self.te_m[mask], re_deg=self.re_deg[mask], yaw_deg=self.yaw_deg[mask]
        )

    def plain(self) -> dict[str, Any]:
        """Return the single figures.

        `success` and its 95 % Wilson interval by heading alone, `success_full` by the whole
        rotation; errors as means and medians over successes (by the whole rotation) and, ending in
        `_all`, over all pairs with an answer.
        """
        by_yaw = Proportion(int(self.success.sum()), len(self))
        full = Proportion(int(self.success_full.sum()), len(self))
        answered = np.isfinite(self.yaw_deg)
        counted = self.success if self.yaw_only else self.success_full
        figures: dict[str, Any] = {
            'pairs': len(self),
            'answered': int(answered.sum()),
            'success': by_yaw.share,
            'success_interval': by_yaw.interval,
        }
        kinds = {'yaw_deg': self.yaw_deg}
        if not self.yaw_only:
            figures['success_full'] = full.share
            figures['success_full_interval'] = full.interval
            kinds |= {'te_m': self.te_m, 're_deg': self.re_deg}
        for name, errors in kinds.items():
            for suffix, mask in (('', counted), ('_all', answered)):
                chosen = errors[mask] if mask.any() else None
                mean = None if chosen is None else float(chosen.mean())
                median = None if chosen is None else float(np.median(chosen))
                figures[f'{name}{suffix}'], figures[f'{name}_median{suffix}'] = mean, median
        figures['prepare_ms'], figures['register_ms'] = self.prepare_ms, self.register_ms
        return figures


def joined_errors(parts: Sequence[RegistrationErrors]) -> RegistrationErrors:
    """Return the errors of one method on the pairs of several drives; times are averaged."""

    def mean(name: str) -> float | None:
        known = [(getattr(p, name), len(p)) for p in parts if getattr(p, name) is not None]
        pairs = sum(number for _, number in known)
        return sum(value * number for value, number in known) / pairs if pairs else None

    return RegistrationErrors(
        np.concatenate([part.te_m for part in parts]),
        np.concatenate([part.re_deg for part in parts]),
        np.concatenate([part.yaw_deg for part in parts]),
        mean('prepare_ms'),
        mean('register_ms'),
        any(part.yaw_only for part in parts),
    )


def errors_of(
    T_estimated: list[se3.Array | None],
    T_true: se3.Array,
    prepare_ms: float | None = None,
    register_ms: float | None = None,
    *,
    yaw_only: bool = False,
) -> RegistrationErrors:
    """Compare poses T_match_query (None: no answer) with the true ones [P x 4 x 4]."""
    te, re, yaw = (np.full(len(T_true), np.nan) for _ in range(3))
    for k, T in enumerate(T_estimated):
        if T is None or not np.isfinite(T).all():
            continue
        te[k], radians = se3.distance(T_true[k], np.asarray(T, np.float64))
        re[k] = np.degrees(radians)
        apart = se3.yaw(T) - se3.yaw(T_true[k])
        yaw[k] = np.degrees(abs((apart + np.pi) % (2.0 * np.pi) - np.pi))
    return RegistrationErrors(te, re, yaw, prepare_ms, register_ms, yaw_only)
