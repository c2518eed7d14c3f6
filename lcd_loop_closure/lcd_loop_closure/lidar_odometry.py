"""Follow a LiDAR from sweep to sweep: KISS-ICP, polished, with an honest covariance."""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_common.se3 import Array
from lcd_common.settings import config, setting
from lcd_loop_closure.kiss_registration import KissRegistration
from lcd_loop_closure.odometry_covariance import (
    MotionCovariance,
    lost_covariance,
    motion_covariance,
)
from lcd_loop_closure.surface_alignment import SurfaceMatches, match_surfaces, polish
from lcd_loop_closure.voxel_gaussians import VoxelGaussians
from lcd_loop_closure.yaw_search import yaw_candidates

_SAMPLE = 1000  # points of a sweep that are matched with surfaces
_RECENT = 20  # sweeps whose fitness says what is usual
_CELL = 4.0  # voxels: residuals in a cell of this size are taken for dependent
_MEMORY = 0.9  # of the disagreement between KISS-ICP and the surfaces, per sweep
_HEADINGS = 4  # that are tried by registration after a search
_YOUNG = 5  # sweeps: the surfaces of a map of fewer are full of the scanner's rings


@config
class OdometryConfig:
    """How sweeps are registered. Lengths fit a car; a slower robot indoors wants a smaller range."""

    max_range: float = setting(100.0, 'farther points are not used', unit='m', low=1.0)
    min_range: float = setting(
        0.0, 'nearer points (the vehicle itself) are not used', unit='m', low=0.0
    )
    voxel_size: float = setting(0.0, 'of the local map; 0 is max_range / 100', unit='m', low=0.0)
    deskew: bool = setting(True, 'undo the motion within a sweep where points carry their time')
    polish: bool = setting(
        True, "move KISS-ICP's pose onto the map's surfaces (point to plane); off: KISS-ICP alone"
    )
    threads: int = setting(
        0, 'of KISS-ICP: 0 is all, 1 repeats exactly; the first odometry of a process decides', low=0
    )
    range_noise: float = setting(
        0.02, 'standard deviation of a range', unit='m', low=0.0001, high=1.0
    )
    unseen_speed: float = setting(
        10.0, 'how wrong the speed may be where a sweep cannot tell', unit='m/s', low=0.01
    )
    unseen_turn_rate: float = setting(
        0.5, 'how wrong the turn rate may be where a sweep cannot tell', unit='rad/s', low=0.01
    )
    lost_turn: float = setting(
        1.5, 'how wrong the heading may be after a sweep that fits nowhere', unit='rad', low=0.01
    )
    min_fitness_ratio: float = setting(
        0.7, 'a sweep that fits less than this share of the usual has failed', low=0.0, high=1.0
    )
    max_lost: int = setting(5, 'failed sweeps in a row after which the map starts anew', low=1)
    min_points: int = setting(100, 'a sweep with fewer usable points is refused', low=10)


@dataclass(frozen=True)
class OdometryEstimate:
    """Where a sweep was taken.

    Attributes:
        stamp_ns: the sweep's stamp; all poses are the lidar's at this instant.
        T_odom_lidar: pose; odom is the frame of the first sweep.
        T_previous_this: motion since the previous sweep; None for the first.
        covariance: 6x6 of T_previous_this, body axes, translation first; None for the first.
        growth: 6x6, what this motion adds to a chain's covariance by `se3.compose_covariance`. Less
            than `covariance`, as the errors of successive motions partly cancel; None for the first.
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


@dataclass(frozen=True)
class _Sweep:
    """A sweep ready to be registered, in the lidar's frame at the middle of its time."""

    points: Array  # all in range
    dense: Array  # for the map
    source: Array  # for KISS-ICP
    sample: Array  # for the surfaces
    middle_s: float  # seconds after the stamp
    timed: bool


@dataclass(frozen=True)
class _Fit:
    T_odom_middle: Array
    disagreement: Array  # twist from KISS-ICP's pose to the polished one
    matches: SurfaceMatches
    reason: str = ''
    recovered: bool = False
    healthy: bool = True


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
        if settings.min_range >= settings.max_range:
            raise ConfigError(
                f'min_range must be below max_range = {settings.max_range:g} m, '
                f'got {settings.min_range:g} m'
            )
        self.settings = settings
        self.voxel_size = settings.voxel_size or settings.max_range / 100.0
        self._kiss = KissRegistration(
            settings.max_range, settings.min_range, self.voxel_size, settings.threads
        )
        self._surfaces = VoxelGaussians(self.voxel_size, settings.max_range)
        self.recoveries = 0
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Forget map and motion; the next sweep starts at the identity."""
        self._first: tuple[PointCloud, int] | None = None
        self._stamp_ns: int | None = None
        self._middle_s = 0.0
        self._T_odom_stamp = np.eye(4)
        self._T_odom_middle = np.eye(4)
        self._twist = np.zeros(6)  # of the last step, m/s and rad/s
        self._deskew_twist = np.zeros(6)  # at the last sweep
        self._lost = 0
        self._forget_map()

    def local_map(self) -> Array:
        """Return the points [N x 3] of the local map, odom frame."""
        return self._kiss.points()

    def register(self, cloud: PointCloud, stamp_ns: int) -> OdometryEstimate:
        """Register a sweep, given in the lidar's frame.

        Raises:
            DataError: the stamp is not after the last one, or too few points are usable. The
                odometry stays as it was.
        """
        if self._stamp_ns is None:
            return self._begin(cloud, stamp_ns, np.zeros(6))
        if stamp_ns <= self._stamp_ns:
            raise DataError(
                f'sweeps must come in the order of their stamps: got {stamp_ns} ns after '
                f'{self._stamp_ns} ns; call reset() when the clock went back'
            )
        sweep = self._prepare(cloud, self._deskew_twist)
        if self._first is not None:
            first, first_ns = self._first
            step_s = (stamp_ns - first_ns) * 1e-9
            motion = self._fit_first_motion(sweep, step_s)
            self._first = None
            self._twist = se3.log(motion) / step_s
            if sweep.timed:
                # Nothing told how the first sweep moved. Now it is known: undo it, begin again.
                self._forget_map()
                self._begin(first, first_ns, self._twist)
                self._first = None
                sweep = self._prepare(cloud, self._twist)
        return self._step(cloud, sweep, stamp_ns)

    def _begin(self, cloud: PointCloud, stamp_ns: int, twist: Array) -> OdometryEstimate:
        sweep = self._prepare(cloud, twist)
        self._first = (cloud, stamp_ns)
        self._stamp_ns, self._middle_s = stamp_ns, sweep.middle_s
        self._twist = self._deskew_twist = twist
        self._T_odom_middle = se3.exp(twist * sweep.middle_s)
        self._start_map(sweep)
        return OdometryEstimate(stamp_ns, np.eye(4), None, None, None, 1.0, 0.0, 0)

    def _fit_first_motion(self, sweep: _Sweep, step_s: float) -> Array:
        """Return the first motion, tried from standing and from driving each way."""
        reach = self.settings.unseen_speed * step_s
        starts = reach * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        prior = self._prior(step_s)
        fits = []
        for x, y in starts:
            guess = self._T_odom_middle @ se3.exp([x, y, 0, 0, 0, 0])
            fits.append(self._fit(sweep, guess, prior))
        best = max(fits, key=lambda fit: fit.matches.fitness)
        return se3.inverse(self._T_odom_middle) @ best.T_odom_middle

    def _step(self, cloud: PointCloud, sweep: _Sweep, stamp_ns: int) -> OdometryEstimate:
        assert self._stamp_ns is not None
        step_s = (stamp_ns - self._stamp_ns) * 1e-9 + sweep.middle_s - self._middle_s
        guess = self._T_odom_middle @ se3.exp(self._twist * step_s)
        prior = self._prior(step_s)
        fit = self._guarded(sweep, guess, prior)
        if fit.healthy and sweep.timed and self.settings.polish:
            sweep, fit = self._deskewed_again(cloud, fit, prior, step_s)
        motion = se3.inverse(self._T_odom_middle) @ fit.T_odom_middle
        twist = se3.log(motion) / step_s
        to_stamp = se3.exp(-twist * sweep.middle_s)
        T_odom_stamp = fit.T_odom_middle @ to_stamp
        T_previous_this = se3.inverse(self._T_odom_stamp) @ T_odom_stamp
        covariance = lost_covariance(
            self.settings.unseen_speed * step_s, self.settings.lost_turn
        )
        if fit.healthy:
            if self._lost == 0:  # else the motion began at a guess
                covariance = self._covariance(sweep, fit, motion, prior)
            self._deskew_twist = self._twist_now(twist)
            self._twist = twist
        self._T_odom_middle, self._T_odom_stamp = fit.T_odom_middle, T_odom_stamp
        if fit.healthy:
            self._accept(sweep, fit, guess)
        else:
            fit = self._lose(sweep, fit)
        self._stamp_ns, self._middle_s = stamp_ns, sweep.middle_s
        shift = se3.adjoint(se3.inverse(to_stamp))
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

    def _twist_now(self, twist: Array) -> Array:
        """Return the twist at a sweep: that of the step lags half a step behind."""
        return twist + 0.5 * (twist - self._twist)

    def _deskewed_again(
        self, cloud: PointCloud, fit: _Fit, prior: Array, step_s: float
    ) -> tuple[_Sweep, _Fit]:
        """Undo the motion within the sweep by the motion that was found, and polish again."""
        motion = se3.inverse(self._T_odom_middle) @ fit.T_odom_middle
        sweep = self._prepare(cloud, self._twist_now(se3.log(motion) / step_s))
        noise = self.settings.range_noise
        T = polish(sweep.sample, fit.T_odom_middle, self._surfaces, noise, prior)
        matches = match_surfaces(sweep.sample, T, self._surfaces, noise)
        return sweep, replace(fit, T_odom_middle=T, matches=matches)

    def _prepare(self, cloud: PointCloud, twist: Array) -> _Sweep:
        """Undo the motion within the sweep and thin it out."""
        cloud = cloud.finite()
        time_s = cloud.time_s if self.settings.deskew else None
        timed = time_s is not None and len(time_s) > 0 and float(np.ptp(time_s)) > 0.0
        begin = end = 0.0
        if time_s is not None and timed:
            begin, end = float(time_s.min()), float(time_s.max())
        # KISS-ICP moves all points to the instant of the last one; a wrong motion harms least when
        # they are taken at the middle.
        points = self._kiss.preprocess(
            cloud.xyz.astype(np.float64),
            time_s.astype(np.float64) if time_s is not None and timed else None,
            se3.exp(twist * (end - begin)),
        )
        if len(points) < self.settings.min_points:
            raise DataError(
                f'a sweep needs {self.settings.min_points} finite points between '
                f'{self.settings.min_range:g} and {self.settings.max_range:g} m, got {len(points)}'
            )
        if timed:
            half = se3.exp(twist * 0.5 * (end - begin))
            points = np.asarray(se3.transform_points(half, points), np.float64)
        dense, source = self._kiss.downsample(points)
        chosen = np.linspace(0, len(source) - 1, min(_SAMPLE, len(source))).astype(int)
        return _Sweep(points, dense, source, source[chosen], 0.5 * (begin + end), timed)

    def _fit(self, sweep: _Sweep, guess: Array, prior: Array, reach: float = 1.0) -> _Fit:
        """Register a sweep from one guess."""
        noise = self.settings.range_noise
        T_kiss = self._kiss.align(sweep.source, guess, reach)
        T_polished = polish(sweep.sample, T_kiss, self._surfaces, noise, prior)
        T = T_polished if self.settings.polish else T_kiss
        matches = match_surfaces(sweep.sample, T, self._surfaces, noise)
        return _Fit(T, se3.log(se3.inverse(T_kiss) @ T_polished), matches)

    def _guarded(self, sweep: _Sweep, guess: Array, prior: Array) -> _Fit:
        """Register a sweep; when it fits badly, search its heading before giving up."""
        fit = self._fit(sweep, guess, prior)
        usual = float(np.median(self._fitness)) if self._fitness else 0.0
        limit = self.settings.min_fitness_ratio * usual
        if fit.matches.fitness >= limit:
            return fit
        reason = f'{fit.matches.fitness:.0%} of the points fit the map, usual are {usual:.0%}'
        centres = [self._T_odom_middle, guess]
        poses = yaw_candidates(sweep.sample, centres, self._surfaces, _HEADINGS)
        others = [self._fit(sweep, T, prior, reach=2.0) for T in poses]
        best = max([fit, *others], key=lambda one: one.matches.fitness)
        if best.matches.fitness < limit:
            return replace(best, reason=reason, healthy=False)
        self.recoveries += 1
        reason += f'; found by a search over headings ({best.matches.fitness:.0%})'
        return replace(best, reason=reason, recovered=True)

    def _accept(self, sweep: _Sweep, fit: _Fit, guess: Array) -> None:
        """Let a well registered sweep into the map."""
        if not fit.recovered:  # a search says nothing about how well motions are guessed
            self._kiss.note_deviation(guess, fit.T_odom_middle)
        self._kiss.add(sweep.dense, fit.T_odom_middle)
        placed = se3.transform_points(fit.T_odom_middle, sweep.dense)
        self._surfaces.add(np.asarray(placed), fit.T_odom_middle[:3, 3])
        self._fitness.append(fit.matches.fitness)
        self._map_sweeps += 1
        self._lost = 0

    def _lose(self, sweep: _Sweep, fit: _Fit) -> _Fit:
        """Keep a badly registered sweep out of the map; after too many of them start a new one."""
        self._lost += 1
        if self._lost < self.settings.max_lost:
            return fit
        self.restarts += 1
        self._forget_map()
        self._start_map(sweep)
        return replace(fit, reason=fit.reason + '; the local map starts anew')

    def _forget_map(self) -> None:
        self._kiss.clear()
        self._surfaces.clear()
        self._fitness: deque[float] = deque(maxlen=_RECENT)
        self._disagreement: Array | None = None
        self._map_sweeps = 0

    def _start_map(self, sweep: _Sweep) -> None:
        T = self._T_odom_middle
        self._kiss.add(sweep.dense, T)
        # All points: the surfaces of one thinned sweep are too few to register the next one well.
        self._surfaces.add(np.asarray(se3.transform_points(T, sweep.points)), T[:3, 3])
        self._map_sweeps = 1
        self._lost = 0

    def _prior(self, step_s: float) -> Array:
        """Return the information about a step that no sweep is needed for."""
        translation = self.settings.unseen_speed * step_s
        rotation = self.settings.unseen_turn_rate * step_s
        return np.diag([translation**-2] * 3 + [rotation**-2] * 3)

    def _covariance(
        self, sweep: _Sweep, fit: _Fit, motion: Array, prior: Array
    ) -> MotionCovariance:
        moved = se3.transform_points(motion, sweep.sample) - sweep.sample
        moved_m = float(np.linalg.norm(moved, axis=1).mean())
        renewed = min(1.0, moved_m / self.voxel_size)
        covariance = motion_covariance(
            fit.matches,
            sweep.sample,
            prior,
            cell_size=_CELL * self.voxel_size,
            renewed=renewed,
        )
        if self.settings.polish:
            if self._map_sweeps >= _YOUNG:
                return covariance
            doubt = np.outer(fit.disagreement, fit.disagreement)
            return MotionCovariance(covariance.step + doubt, covariance.growth + doubt)
        # KISS-ICP's own pose is not where the normal equations have their minimum: add how far it
        # lately was from there.
        square = np.outer(fit.disagreement, fit.disagreement)
        before = square if self._disagreement is None else self._disagreement
        self._disagreement = _MEMORY * before + (1.0 - _MEMORY) * square
        return MotionCovariance(
            covariance.step + self._disagreement,
            covariance.growth + renewed * self._disagreement,
        )
