"""Track a vehicle in six degrees of freedom: inertial samples move it, observations correct it."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from cmrnet_ekf.ekf.constraints import Constraints
from cmrnet_ekf.ekf.covariance_check import used_covariance
from cmrnet_ekf.ekf.ekf_settings import EkfSettings
from cmrnet_ekf.ekf.history import Entry, History
from cmrnet_ekf.ekf.motion_state import (
    POSE,
    MotionState,
    cloned,
    without_clone,
)
from cmrnet_ekf.ekf.observations import ALL6, Observation, RelativeObservation
from cmrnet_ekf.ekf.propagation import Propagation
from cmrnet_ekf.ekf.start_state import start_state
from cmrnet_ekf.ekf.update import Update, Verdict
from lcd_common import se3
from lcd_common.errors import DataError

# At one stamp the sample comes first, then observations; clones are of the corrected pose.
_SAMPLE, _SEEN, _CLONE = 0, 1, 2
_WAITING_SAMPLES = 1000


@dataclass(frozen=True)
class Estimate:
    """Where the vehicle is and how it moves, in its body axes (se3's conventions).

    Attributes:
        stamp_ns: time.
        T_map_body: pose.
        covariance: of the pose, 6x6 in body axes, translation first.
        twist: velocity and turn rate in body axes [6], m/s and rad/s.
        twist_covariance: of the twist, 6x6 in body axes.
        state: all there is to know.
    """

    stamp_ns: int
    T_map_body: se3.Array
    covariance: se3.Array
    twist: se3.Array
    twist_covariance: se3.Array
    state: MotionState


class VehicleEkf:
    """An error-state EKF with a history, so that late input counts as if it had come in time.

    The body frame is that of the inertial sensor (or the vehicle's where there is none); whatever
    observes another frame says where that sits. Nothing happens before `start`.

    Args:
        settings: of motion, start, gate and history.
        T_body_base: where the vehicle's base lies in the body frame, for the constraints.
    """

    def __init__(self, settings: EkfSettings, T_body_base: se3.Array | None = None) -> None:
        self.settings = settings
        self.propagation = Propagation(settings.motion)
        self._hold_ns = round(settings.motion.imu_hold * 1e9)
        self._update = Update(settings.gate)
        base = np.eye(4) if T_body_base is None else T_body_base
        self._constraints = Constraints(settings.constraint, base, self._update)
        self._history: History[Verdict | None] | None = None
        self._early: deque[tuple[int, se3.Array, se3.Array, bool]] = deque(maxlen=_WAITING_SAMPLES)
        self.on_verdict: Callable[[Verdict], None] | None = None

    @property
    def started(self) -> bool:
        """Whether there is a pose."""
        return self._history is not None

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest input, None before the start."""
        return None if self._history is None else self._history.newest.stamp_ns

    @property
    def replayed(self) -> int:
        """How many entries of the history were gone through again because something came late."""
        return 0 if self._history is None else self._history.replayed

    def start(
        self,
        stamp_ns: int,
        T_map_body: se3.Array,
        covariance: se3.Array | None = None,
        velocity_map: se3.Array | None = None,
        velocity_sigma: float | None = None,
    ) -> None:
        """Start, or start again, at a pose; samples that came before take part where they can.

        Args:
            stamp_ns: of the pose.
            T_map_body: the pose.
            covariance: 6x6 in body axes; None: the settings' sigmas.
            velocity_map: [3], None: zero.
            velocity_sigma: None: the settings'.

        Raises:
            DataError: the pose is not finite, or the covariance is none.
        """
        if not np.isfinite(T_map_body).all():
            raise DataError('expected a finite pose to start at, got NaN or infinity')
        if covariance is not None:
            covariance = used_covariance(covariance, np.ones(6, np.bool_), 'start pose')
        kept = None if self._history is None else self._history.newest
        state = start_state(
            self.settings, stamp_ns, T_map_body, covariance, velocity_map, velocity_sigma, kept
        )
        self._history = History(state, round(self.settings.history.length * 1e9))
        # The sample that held at the stamp, and those since.
        for at_ns, turn_rate, force, doubtful in sorted(self._early, key=lambda sample: sample[0]):
            if at_ns <= stamp_ns:
                state = replace(
                    state,
                    turn_rate=turn_rate,
                    force=force,
                    imu_ns=at_ns,
                    doubtful=doubtful,
                    intervals_ns=state.intervals_until(at_ns, self._hold_ns),
                )
                self._history = History(state, round(self.settings.history.length * 1e9))
            elif at_ns != self._history.newest.imu_ns:
                self._put_sample(at_ns, turn_rate, force, doubtful)

    def reset(self) -> None:
        """Forget everything; nothing happens until the next start."""
        self._history = None
        self._early.clear()

    def add_imu(
        self, stamp_ns: int, turn_rate: se3.Array, force: se3.Array, *, doubtful: bool = False
    ) -> None:
        """Take an inertial sample: turn rate and specific force (+g up at rest) in body axes [3].

        A doubtful one is a guess: it moves the estimate, but with the noise of coasting.

        Raises:
            DataError: it is not finite, repeats a stamp or is older than the history.
        """
        if not math.isfinite(sum(turn_rate.tolist()) + sum(force.tolist())):
            raise DataError('imu: expected finite rates and accelerations, got NaN or infinity')
        if self._early and stamp_ns == self._early[-1][0]:
            raise DataError(f'imu: a sample repeats the stamp {stamp_ns}')
        self._early.append((stamp_ns, turn_rate, force, doubtful))
        if self._history is not None:
            self._put_sample(stamp_ns, turn_rate, force, doubtful)

    def observe(self, seen: Observation) -> Verdict:
        """Correct by an observation, however late within the history it comes.

        Raises:
            DataError: its covariance is none (see `used_covariance`), its numbers are not finite,
                it repeats a stamp of its source, or it is older than the history; the text says
                what came.
        """
        history = self._history
        if history is None:
            raise DataError(f'{seen.source}: the filter has not started: give it a pose first')
        seen = _checked(seen)
        first_ns = seen.from_ns if isinstance(seen, RelativeObservation) else seen.stamp_ns
        if first_ns < history.begin_ns:
            late = (history.newest.stamp_ns - first_ns) * 1e-9
            raise DataError(
                f'{seen.source}: {late:.2f} s late, the history is only '
                f'{self.settings.history.length:g} s: a larger history.length keeps more'
            )
        key = (seen.stamp_ns, _SEEN, seen.source, first_ns)
        if history.knows(key):
            raise DataError(f'{seen.source}: an observation repeats the stamp {seen.stamp_ns}')
        entries: list[Entry[Verdict | None]] = [Entry(key, partial(self._see, seen))]
        if isinstance(seen, RelativeObservation):
            clone = (seen.from_ns, _CLONE, seen.source, seen.stamp_ns)
            entries.append(Entry(clone, partial(self._clone, seen)))
        verdict = history.put(*entries)[0]
        assert verdict is not None
        if self.on_verdict is not None:
            self.on_verdict(verdict)
        return verdict

    def estimate(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return the estimate at a stamp, by default that of the newest input.

        A later stamp is predicted, at most `max_prediction` ahead; an earlier one is taken from the
        history. None before the start, and before the history.
        """
        history = self._history
        if history is None:
            return None
        state: MotionState | None = history.newest
        if stamp_ns is not None and stamp_ns != history.newest.stamp_ns:
            state = history.at(stamp_ns)
            if state is None:
                return None
            ahead_ns = round(self.settings.history.max_prediction * 1e9)
            state = self.propagation.to(state, min(stamp_ns, history.newest.stamp_ns + ahead_ns))
        assert state is not None
        return _estimate(state, self.settings.motion.gyroscope_noise)

    def _put_sample(
        self, stamp_ns: int, turn_rate: se3.Array, force: se3.Array, doubtful: bool
    ) -> None:
        history = self._history
        assert history is not None
        if stamp_ns < history.begin_ns:
            raise DataError('imu: a sample is older than the history')
        key = (stamp_ns, _SAMPLE, '', 0)
        if history.knows(key):
            raise DataError(f'imu: a sample repeats the stamp {stamp_ns}')
        history.put(Entry(key, partial(self._sample, stamp_ns, turn_rate, force, doubtful)))

    def _sample(
        self,
        stamp_ns: int,
        turn_rate: se3.Array,
        force: se3.Array,
        doubtful: bool,
        state: MotionState,
    ) -> tuple[MotionState, None]:
        before_ns = state.imu_ns
        intervals_ns = state.intervals_until(stamp_ns, self._hold_ns)
        state = self.propagation.to(state, stamp_ns)
        # By hand, for this is done for every sample: replace() takes longer.
        state = MotionState(
            stamp_ns,
            state.R,
            state.p,
            state.v,
            state.gyroscope_bias,
            state.accelerometer_bias,
            state.covariance,
            turn_rate,
            force,
            stamp_ns,
            doubtful,
            state.clones,
            state.memory,
            intervals_ns,
        )
        if self._constraints.due(before_ns, stamp_ns):
            state = self._constraints.hold(state)
        return state, None

    def _see(self, seen: Observation, state: MotionState) -> tuple[MotionState, Verdict]:
        state, verdict = self._update(self.propagation.to(state, seen.stamp_ns), seen)
        if isinstance(seen, RelativeObservation):
            index = seen.clone_index(state)
            assert index is not None
            state = without_clone(state, index)
        return state, verdict

    def _clone(self, seen: RelativeObservation, state: MotionState) -> tuple[MotionState, None]:
        return cloned(self.propagation.to(state, seen.from_ns), seen.source), None


def _checked(seen: Observation) -> Observation:
    axes = np.array(seen.axes)
    if not np.isfinite(seen.numbers[axes] if seen.numbers.ndim == 1 else seen.numbers).all():
        raise DataError(f'{seen.source}: expected finite numbers, got NaN or infinity')
    if isinstance(seen, RelativeObservation) and seen.from_ns >= seen.stamp_ns:
        raise DataError(f'{seen.source}: a motion must end after it begins')
    if seen.axes == ALL6 or len(seen.axes) == 3:
        covariance = used_covariance(seen.covariance, axes, seen.source)
    else:
        # Rows of other axes were set to 1 by whoever chose the axes (they know the parent's axes).
        covariance = used_covariance(seen.covariance, np.ones(6, np.bool_), seen.source)
    return replace(seen, covariance=covariance)


def _estimate(state: MotionState, gyroscope_noise: float) -> Estimate:
    turning = state.turn_rate is not None
    w = state.turn_rate - state.gyroscope_bias if state.turn_rate is not None else np.zeros(3)
    v = state.R.T @ state.v
    J = np.zeros((6, len(state.covariance)))
    J[:3, 6:9] = np.eye(3)
    J[:3, 3:6] = se3.hat(v)
    if turning:
        J[3:, 9:12] = -np.eye(3)
    twist_covariance = J @ state.covariance @ J.T
    # One sample's noise is white: its variance grows with the rate at which samples come. Without
    # one nothing is known of the turn.
    twist_covariance[3:, 3:] += np.eye(3) * (state.imu_hz * gyroscope_noise**2 if turning else 1.0)
    return Estimate(
        state.stamp_ns,
        state.T_map_body,
        state.covariance[POSE, POSE],
        np.concatenate([v, w]),
        twist_covariance,
        state,
    )
