"""Follow a LiDAR from sweep to sweep: KISS-ICP, polished, with an honest covariance."""

from dataclasses import dataclass, replace

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.se3 import Array
from lcd_loop_closure.odometry_config import OdometryConfig
from lcd_loop_closure.odometry_covariance import (
    MotionCovariance,
    lost_covariance,
    motion_covariance,
)
from lcd_loop_closure.sweep_registration import Fit, Sweep, SweepRegistration
from lcd_loop_closure.unsteady_motion import UnsteadyMotion

__all__ = ['LidarOdometry', 'OdometryConfig', 'OdometryEstimate']

_CELL = 4.0  # voxels: residuals in a cell of this size are taken for dependent
_MEMORY = 0.9  # of the disagreement between KISS-ICP and the surfaces, per sweep
_STARTS = np.array([0.35, 0.7, 1.05])  # of the distance that the vehicle may drive per sweep
_FEW = 4  # every so many points are enough to tell these starts apart
_NOT_WORSE = 0.95  # a motion that is not what it seemed makes a sweep fit less
_YOUNG = 5  # sweeps: the surfaces of a map of fewer are full of the scanner's rings


@dataclass(frozen=True)
class OdometryEstimate:
    """Where a sweep was taken.

    Attributes:
        stamp_ns: the sweep's stamp; all poses are the lidar's at this instant.
        T_odom_lidar: pose; odom is the frame of the first sweep.
        T_previous_this: motion since the previous sweep; None for the first.
        covariance: 6x6 of T_previous_this, body axes, translation first; None for the first.
        growth: 6x6, what this motion adds to the covariance of a chain by `se3.compose_covariance`;
            None for the first. Less than `covariance`: successive errors partly cancel.
        fitness: share of the points that lie on the local map's surfaces, 0..1.
        rmse_m: weighted root mean square distance to these surfaces, metres.
        inliers: how many distances to surfaces were used.
        healthy: False when the sweep fits the map badly: the pose is a guess.
        recovered: True when it fitted only after a search over headings.
        reason: why it is not healthy, or what was done about it; empty otherwise.
    """

    stamp_ns: int
    T_odom_lidar: Array
    T_previous_this: Array | None
    covariance: Array | None
    growth: Array | None
    fitness: float
    rmse_m: float
    inliers: int
    healthy: bool = True
    recovered: bool = False
    reason: str = ''


class LidarOdometry:
    """Register each sweep against a local map of the ones before.

    The steps and their order are KISS-ICP's; without `polish` its poses come out. Added are: a
    motion guess by stamps (a lost sweep is no jump), the pose at the stamp instead of the sweep's
    end, the polish, the covariance, and the guard against failed registrations.
    """

    def __init__(self, settings: OdometryConfig) -> None:
        """Start at the identity.

        Raises:
            ConfigError: min_range is not below max_range.
        """
        self.settings = settings
        self._registration = SweepRegistration(settings)
        self.recoveries = 0
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget map and motion; the next sweep starts at the identity."""
        self._first: PointCloud | None = None
        self._stamp_ns: int | None = None
        self._middle_s = 0.0
        self._T_odom_stamp = np.eye(4)
        self._T_odom_middle = np.eye(4)
        self._twist = np.zeros(6)  # of the last step, m/s and rad/s
        self._twist_at_middle = np.zeros(6)  # at the last sweep
        self._unsteady = UnsteadyMotion()
        self._disagreement: Array | None = None
        self._lost = 0
        self._located: tuple[Sweep, Fit, Array] | None = None
        self._registration.clear()

    def local_map(self) -> Array:
        """Return the points [N x 3] of the local map, odom frame."""
        return self._registration.points()

    def register(self, cloud: PointCloud, stamp_ns: int) -> OdometryEstimate:
        """Locate a sweep, given in the lidar's frame, and take it into the map.

        Raises:
            DataError: the stamp is not after the last one, or too few points are usable. The
                odometry stays as it was.
        """
        estimate = self.locate(cloud, stamp_ns)
        self.absorb()
        return estimate

    def absorb(self) -> None:
        """Take the sweep that was located last into the map, if that is still to be done."""
        located, self._located = self._located, None
        if located is not None:
            self._registration.accept(*located)

    def locate(self, cloud: PointCloud, stamp_ns: int) -> OdometryEstimate:
        """Say where a sweep was taken, before the time that `absorb` takes.

        Raises:
            DataError: as `register`.
        """
        self.absorb()
        if self._stamp_ns is None:
            return self._begin(cloud, stamp_ns, np.zeros(6))
        if stamp_ns <= self._stamp_ns:
            raise DataError(
                f'sweeps must come in the order of their stamps: got {stamp_ns} ns after '
                f'{self._stamp_ns} ns; call reset() when the clock went back'
            )
        sweep = self._registration.prepare(cloud, self._twist_at_middle)
        first, first_ns, self._first = self._first, self._stamp_ns, None
        if first is not None:
            self._twist = self._first_twist(sweep, (stamp_ns - first_ns) * 1e-9)
            if sweep.timed:
                # Nothing told how the first sweep moved. Now it is known: undo it, begin again.
                self._registration.clear()
                self._begin(first, first_ns, self._twist)
                self._first = None
                sweep = self._registration.prepare(cloud, self._twist)
        return self._step(cloud, sweep, stamp_ns)

    def _begin(self, cloud: PointCloud, stamp_ns: int, twist: Array) -> OdometryEstimate:
        sweep = self._registration.prepare(cloud, twist)
        self._first, self._stamp_ns, self._middle_s = cloud, stamp_ns, sweep.middle_s
        self._twist = self._twist_at_middle = twist
        self._T_odom_middle = se3.exp(twist * sweep.middle_s)
        self._registration.start(sweep, self._T_odom_middle)
        return OdometryEstimate(stamp_ns, np.eye(4), None, None, None, 1.0, 0.0, 0)

    def _first_twist(self, sweep: Sweep, step_s: float) -> Array:
        """Return the first motion, tried from standing and from driving each way.

        KISS-ICP alone would mostly find that the vehicle stands, held by the rings on the ground.
        """
        prior = self._prior(step_s)
        few = replace(sweep, sample=sweep.sample[::_FEW])
        standing = self._registration.fit(sweep, self._T_odom_middle, prior)
        best = self._registration.polished(few, standing.T_odom_middle, prior)
        for metres in self.settings.unseen_speed * step_s * _STARTS:
            for angle in np.arange(8) * np.pi / 4:
                drive = [metres * np.cos(angle), metres * np.sin(angle), 0, 0, 0, 0]
                start = self._T_odom_middle @ se3.exp(drive)
                fit = self._registration.polished(few, start, prior)
                if fit.matches.fitness > best.matches.fitness:
                    best = fit
        return se3.log(se3.inverse(self._T_odom_middle) @ best.T_odom_middle) / step_s

    def _step(self, cloud: PointCloud, sweep: Sweep, stamp_ns: int) -> OdometryEstimate:
        assert self._stamp_ns is not None
        step_s = (stamp_ns - self._stamp_ns) * 1e-9 + sweep.middle_s - self._middle_s
        guess = self._T_odom_middle @ se3.exp(self._twist * step_s)
        prior = self._prior(step_s)
        sweep, fit = self._registration.guarded(cloud, sweep, self._T_odom_middle, guess, prior)
        self.recoveries += fit.recovered
        self._unsteady.steady &= fit.healthy and not fit.recovered
        motion, change = self._motion(fit, step_s)
        if sweep.timed and self.settings.polish and fit.healthy and not fit.recovered:
            # The motion within the sweep was undone by a guess of it; now it is known better.
            now = self._unsteady.at_middle(motion, change) / step_s
            again = self._registration.prepare(cloud, now)
            better = self._registration.polished(again, fit.T_odom_middle, prior)
            if better.matches.fitness > _NOT_WORSE * fit.matches.fitness:
                sweep, fit = again, replace(better, disagreement=fit.disagreement)
                motion, change = self._motion(fit, step_s)
        share = sweep.middle_s / step_s
        T_middle_stamp = self._unsteady.to_stamp(share, motion, change)
        T_odom_stamp = fit.T_odom_middle @ T_middle_stamp
        T_previous_this = se3.inverse(self._T_odom_stamp) @ T_odom_stamp
        covariance = self._covariance(sweep, fit, motion, change, step_s)
        if fit.healthy:
            self._twist = motion / step_s
            self._twist_at_middle = self._unsteady.at_middle(motion, change) / step_s
            self._unsteady.take(change, steady=not fit.recovered)
            self._located = sweep, fit, guess
            self._lost = 0
        else:
            fit = self._lose(sweep, fit)
        self._stamp_ns, self._middle_s = stamp_ns, sweep.middle_s
        self._T_odom_middle, self._T_odom_stamp = fit.T_odom_middle, T_odom_stamp
        shift = se3.adjoint(se3.inverse(T_middle_stamp))
        return OdometryEstimate(
            stamp_ns=stamp_ns,
            T_odom_lidar=T_odom_stamp,
            T_previous_this=T_previous_this,
            covariance=shift @ covariance.step @ shift.T,
            growth=shift @ covariance.growth @ shift.T,
            fitness=fit.matches.fitness,
            rmse_m=fit.matches.rmse_m,
            inliers=len(fit.matches.residual),
            healthy=fit.healthy,
            recovered=fit.recovered,
            reason=fit.reason,
        )

    def _motion(self, fit: Fit, step_s: float) -> tuple[Array, Array]:
        """Return the twist of the step to a fit, and its change since the step before."""
        motion = se3.log(se3.inverse(self._T_odom_middle) @ fit.T_odom_middle)
        return motion, motion - self._twist * step_s

    def _lose(self, sweep: Sweep, fit: Fit) -> Fit:
        """Keep a badly registered sweep out of the map; after too many of them start a new one."""
        self._lost += 1
        if self._lost < self.settings.max_lost:
            return fit
        self.restarts += 1
        self._registration.clear()
        self._registration.start(sweep, fit.T_odom_middle)
        return replace(fit, reason=fit.reason + '; the local map starts anew')

    def _prior(self, step_s: float) -> Array:
        """Return the information about a step that no sweep is needed for."""
        translation = self.settings.unseen_speed * step_s
        rotation = self.settings.unseen_turn_rate * step_s
        return np.diag([translation**-2] * 3 + [rotation**-2] * 3)

    def _covariance(
        self, sweep: Sweep, fit: Fit, motion: Array, change: Array, step_s: float
    ) -> MotionCovariance:
        """Return the covariance of a step; `motion` and `change` are twists of the whole step."""
        share = sweep.middle_s / step_s
        if not fit.healthy or self._lost:  # the motion ends or began at a guess
            lost = lost_covariance(self.settings.unseen_speed * step_s, self.settings.lost_turn)
            self._unsteady.lose(lost.step, share)
            return lost
        moved = se3.transform_points(se3.exp(motion), sweep.sample) - sweep.sample
        moved_m = float(np.linalg.norm(moved, axis=1).mean())
        renewed = min(1.0, moved_m / self._registration.voxel_size)
        covariance = motion_covariance(
            fit.matches,
            sweep.sample,
            self._prior(step_s),
            cell_size=_CELL * self._registration.voxel_size,
            renewed=renewed,
        )
        doubt = self._doubt(fit)
        step, growth = covariance.step + doubt, covariance.growth + renewed * doubt
        if sweep.timed:
            unsteady = self._unsteady.covariance(change, share)
            step, growth = step + unsteady, growth + 0.5 * unsteady
        return MotionCovariance(step, growth)

    def _doubt(self, fit: Fit) -> Array:
        """Return how much KISS-ICP and the surfaces disagree, 6x6, where that tells an error.

        Without the polish the pose is not where the normal equations have their minimum, but lately
        so far from there. With it, only the surfaces of a young map are to be doubted.
        """
        square = np.outer(fit.disagreement, fit.disagreement)
        if self.settings.polish:
            return square * float(self._registration.sweeps < _YOUNG)
        before = square if self._disagreement is None else self._disagreement
        self._disagreement = _MEMORY * before + (1.0 - _MEMORY) * square
        return self._disagreement
