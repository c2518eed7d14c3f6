"""Correct the filter's state by an observation, if it can be believed."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import chi2

from cmrnet_ekf.ekf.ekf_settings import GateConfig
from cmrnet_ekf.ekf.motion_state import (
    POSITION,
    ROTATION,
    VELOCITY,
    Memory,
    MotionState,
    corrected,
)
from cmrnet_ekf.ekf.observations import (
    Innovation,
    Observation,
    PoseObservation,
    PositionObservation,
    TwistObservation,
)
from lcd_common import se3

# Giving in: how wrong velocity and heading may have become at most.
_MOST_SPEED_MPS = 20.0
_MOST_TURN_RAD = 0.5


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of an observation.

    Attributes:
        source, stamp_ns: which one it was.
        accepted: it corrected the state.
        recovered: it did so because many rejected ones before it agreed with it.
        nis: normalised innovation squared (chi-square of `dof` when all is well).
        dof: rows that counted; with none nothing was observed.
        whitened: the innovation in units of its covariance's Cholesky factor [dof].
    """

    source: str
    stamp_ns: int
    accepted: bool
    recovered: bool
    nis: float
    dof: int
    whitened: se3.Array


class Update:
    """Update states; the gate tests the innovation with its whole covariance H P H' + R."""

    def __init__(self, gate: GateConfig) -> None:
        self.gate = gate

    def __call__(self, state: MotionState, seen: Observation) -> tuple[MotionState, Verdict]:
        """Return the state after an observation at its stamp, and what became of that."""
        memory = state.remembered(seen.source)
        innovation = _inflated(seen.innovation(state), seen, memory)
        dof = len(innovation.residual)
        if dof == 0:
            return state, Verdict(seen.source, seen.stamp_ns, False, False, 0.0, 0, np.zeros(0))
        PHt = state.covariance @ innovation.H.T
        S = innovation.H @ PHt + innovation.covariance
        whitened = np.linalg.solve(np.linalg.cholesky(S), innovation.residual)
        nis = float(whitened @ whitened)
        accepted = nis <= _threshold(self.gate.probability, dof)
        rejected, recovered = 0, False
        if not accepted:
            rejected = 1 + self._agreeing(innovation, seen, memory)
            if self._gives_in(state, seen, memory, rejected):
                state = self._give_in(state, innovation, seen, memory)
                PHt = state.covariance @ innovation.H.T
                S = innovation.H @ PHt + innovation.covariance
                recovered = True
        verdict = Verdict(
            seen.source, seen.stamp_ns, accepted or recovered, recovered, nis, dof, whitened
        )
        absolute = isinstance(seen, PoseObservation | PositionObservation)
        if not verdict.accepted:
            accepted_ns = None if memory is None else memory.accepted_ns
            return state.remembering(
                seen.source,
                Memory(
                    seen.stamp_ns,
                    accepted_ns,
                    absolute,
                    rejected,
                    innovation.residual,
                    innovation.covariance,
                ),
            ), verdict
        state = _updated(state, innovation, PHt, S)
        return state.remembering(
            seen.source, Memory(seen.stamp_ns, seen.stamp_ns, absolute)
        ), verdict

    def _gives_in(
        self, state: MotionState, seen: Observation, memory: Memory | None, rejected: int
    ) -> bool:
        if not self.gate.recover_after:
            return False
        since_ns = seen.stamp_ns - round(self.gate.recover_time * 1e9)
        for name, other in state.memory:
            supported = other.absolute and other.accepted_ns is not None
            if name != seen.source and supported and (other.accepted_ns or 0) > since_ns:
                return False
        accepted_ns = None if memory is None else memory.accepted_ns
        long_ago = accepted_ns is None or accepted_ns <= since_ns
        return rejected >= (
            min(3, self.gate.recover_after) if long_ago else self.gate.recover_after
        )

    def _agreeing(self, innovation: Innovation, seen: Observation, memory: Memory | None) -> int:
        """Return how many rejections in a row there were that this one agrees with.

        Wrong observations are wrong each in its own way; when they all say the same, the filter is
        what is wrong.
        """
        if memory is None or memory.residual is None or memory.covariance is None:
            return 0
        if innovation.residual.shape != memory.residual.shape:
            return 0
        difference = innovation.residual - memory.residual
        dt = max(seen.stamp_ns - memory.stamp_ns, 0) * 1e-9
        S = innovation.covariance + memory.covariance
        drift = np.full(len(difference), (self.gate.recover_speed * dt) ** 2)
        drift[_angles(seen, len(difference))] = (self.gate.recover_turn * dt) ** 2
        S[np.diag_indices(len(S))] += drift
        nis = float(difference @ np.linalg.solve(S, difference))
        return memory.rejected if nis <= _threshold(0.999, len(difference)) else 0

    def _give_in(
        self, state: MotionState, innovation: Innovation, seen: Observation, memory: Memory | None
    ) -> MotionState:
        """Make the state as uncertain as the observation says that it is wrong."""
        error = np.linalg.lstsq(innovation.H[:, :9], innovation.residual, rcond=None)[0]
        accepted_ns = None if memory is None else memory.accepted_ns
        gap = 10.0 if accepted_ns is None else max((seen.stamp_ns - accepted_ns) * 1e-9, 0.1)
        off = float(np.linalg.norm(error[POSITION]))
        speed = min(off / gap + float(np.linalg.norm(error[VELOCITY])), _MOST_SPEED_MPS)
        turn = min(self.gate.recover_turn * gap, _MOST_TURN_RAD)
        turn = max(turn, float(np.linalg.norm(error[ROTATION])))
        P = state.covariance.copy()
        diagonal = P.reshape(-1)[:: len(P) + 1]
        for rows, sigma in ((POSITION, off), (ROTATION, turn), (VELOCITY, speed)):
            diagonal[rows] += sigma**2
        # The clones' errors are those of the time before: they stay as they are.
        return corrected(state, np.zeros(len(P)), P)


def _updated(
    state: MotionState, innovation: Innovation, PHt: se3.Array, S: se3.Array
) -> MotionState:
    K = np.linalg.solve(S, PHt.T).T
    # Joseph's form stays symmetric and positive whatever the rounding.
    A = -K @ innovation.H
    A[np.diag_indices(len(A))] += 1.0
    P = A @ state.covariance @ A.T + K @ innovation.covariance @ K.T
    return corrected(state, K @ innovation.residual, 0.5 * (P + P.T))


def _inflated(innovation: Innovation, seen: Observation, memory: Memory | None) -> Innovation:
    """Count correlated observations for what they are worth together.

    Errors that fade with `correlation_s` (first-order Gauss-Markov, a = exp(-dt / correlation_s))
    say (1 - a) / (1 + a) as much as independent ones (Priestley 1981, effective sample size).
    """
    if not seen.correlation_s or memory is None or memory.accepted_ns is None:
        return innovation
    dt = max((seen.stamp_ns - memory.accepted_ns) * 1e-9, 1e-3)
    factor = 1.0 / math.tanh(0.5 * dt / seen.correlation_s)  # (1 + a) / (1 - a)
    return Innovation(innovation.residual, innovation.H, innovation.covariance * factor)


def _angles(seen: Observation, rows: int) -> list[int]:
    if isinstance(seen, TwistObservation) or len(seen.axes) == 3:
        return []
    used = [axis for axis, counts in enumerate(seen.axes) if counts]
    return [row for row in range(rows) if used[row] >= 3]


@lru_cache(maxsize=64)
def _threshold(probability: float, dof: int) -> float:
    return float(chi2.ppf(probability, dof))
