"""Register sweeps against the local map of the ones before, and notice when one does not fit."""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_common.se3 import Array
from lcd_loop_closure.kiss_registration import KissRegistration
from lcd_loop_closure.odometry_config import OdometryConfig
from lcd_loop_closure.surface_alignment import SurfaceMatches, match_surfaces, polish
from lcd_loop_closure.voxel_gaussians import VoxelGaussians
from lcd_loop_closure.yaw_search import yaw_candidates

_SAMPLE = 1000  # points of a sweep that are matched with surfaces
_THIN_SHARE = 3  # one point of so many is enough for a pose that the polish will improve
_RECENT = 20  # sweeps whose fitness says what is usual
_DOUBTFUL = 0.75  # of the usual fitness: less is worth a search
_BETTER = 1.1  # times the fitness that a search must find to be believed
_SUSPICIOUS = 0.2  # voxels between the guess and KISS-ICP's pose
_NEW = 0.9  # times the fitness after a search in vain: less is worth another one
_TURNS, _TURN_SPAN = 20, np.radians(40.0)  # headings near the guess, for a turn that began
_HEADINGS = 4  # that are tried by registration after a search


@dataclass(frozen=True)
class Sweep:
    """A sweep ready to be registered, in the lidar's frame at the middle of its time.

    Attributes:
        points: [N x 3] float64, all in range.
        dense, source: [. x 3] thinned for the map and for KISS-ICP.
        sample: [. x 3] the points that are matched with surfaces.
        middle_s: the middle, seconds after the sweep's stamp.
        timed: whether the points carried their time and the motion was undone.
    """

    points: Array
    dense: Array
    source: Array
    sample: Array
    middle_s: float
    timed: bool


@dataclass(frozen=True)
class Fit:
    """How a sweep lies in the map.

    Attributes:
        T_odom_middle: pose of the lidar in the middle of the sweep.
        matches: with the surfaces, at the pose.
        disagreement: [6] twist from KISS-ICP's pose to that on the surfaces; zero where it is none.
        surprised: the motion changed too abruptly to tell how well motions are guessed.
        healthy, recovered, reason: as of OdometryEstimate.
    """

    T_odom_middle: Array
    matches: SurfaceMatches
    disagreement: Array = field(default_factory=lambda: np.zeros(6))
    surprised: bool = False
    healthy: bool = True
    recovered: bool = False
    reason: str = ''


class SweepRegistration:
    """Hold the local map: KISS-ICP's points and, beside them, their surfaces."""

    def __init__(self, settings: OdometryConfig) -> None:
        """Start with an empty map.

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
        self.clear()

    def clear(self) -> None:
        """Forget the map."""
        self._kiss.clear()
        self._surfaces.clear()
        self._fitness: deque[float] = deque(maxlen=_RECENT)
        self._searched = 1.0
        self.sweeps = 0

    @property
    def _polish_ends_it(self) -> bool:
        """Whether the map's surfaces are known well enough to leave the end to the polish."""
        return self.settings.polish and self.sweeps >= _RECENT

    def points(self) -> Array:
        """Return the points [N x 3] of the map, odom frame."""
        return self._kiss.points()

    def prepare(self, cloud: PointCloud, twist: Array) -> Sweep:
        """Undo the motion within a sweep and thin it out.

        Args:
            cloud: in the lidar's frame.
            twist: [6] motion of the lidar in the middle of the sweep, m/s and rad/s.

        Raises:
            DataError: too few points are usable.
        """
        cloud = cloud.finite()
        time_s = cloud.time_s if self.settings.deskew else None
        begin = end = 0.0
        if time_s is not None and len(time_s):
            begin, end = float(time_s.min()), float(time_s.max())
        timed = end > begin
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
        return Sweep(points, dense, source, source[chosen], 0.5 * (begin + end), timed)

    def fit(
        self,
        sweep: Sweep,
        guess: Array,
        prior: Array,
        *,
        rough: bool = False,
        brief: bool = False,
        thin: bool = False,
    ) -> Fit:
        """Register a sweep from one guess.

        Args:
            sweep: what to register.
            guess: T_odom_middle to start from.
            prior: 6x6 information that keeps what the sweep does not tell.
            rough: for a guess that may be far off or wrong.
            brief: thin, and leave the last centimetres to the polish, which is faster at it.
            thin: with a part of the points, for a pose that the polish will improve.
        """
        source = sweep.source[::_THIN_SHARE] if thin or brief else sweep.source
        T_kiss = self._kiss.align(source, guess, rough=rough, brief=brief)
        on_surfaces = self.polished(sweep, T_kiss, prior)
        disagreement = se3.log(se3.inverse(T_kiss) @ on_surfaces.T_odom_middle)
        if not self.settings.polish:
            noise = self.settings.range_noise
            matches = match_surfaces(sweep.sample, T_kiss, self._surfaces, noise)
            return Fit(T_kiss, matches, disagreement)
        best = on_surfaces
        moved_m = se3.distance(guess, T_kiss)[0]
        if not rough and moved_m > _SUSPICIOUS * self.voxel_size:
            # A scanner's own rings on the ground may have pulled KISS-ICP off a good guess.
            from_guess = self.polished(sweep, guess, prior)
            best = max(on_surfaces, from_guess, key=lambda one: one.matches.fitness)
        return replace(best, disagreement=disagreement)

    def polished(self, sweep: Sweep, T_odom_middle: Array, prior: Array) -> Fit:
        """Return the fit on the surfaces nearest to a pose."""
        noise = self.settings.range_noise
        T = polish(sweep.sample, T_odom_middle, self._surfaces, noise, prior)
        return Fit(T, match_surfaces(sweep.sample, T, self._surfaces, noise))

    def guarded(
        self, cloud: PointCloud, sweep: Sweep, T_odom_last: Array, guess: Array, prior: Array
    ) -> tuple[Sweep, Fit]:
        """Register a sweep; when it fits badly, search its heading before giving up.

        Returns:
            The sweep, which may have been prepared anew, and its fit: recovered by the search, or
            not healthy; then its pose is the guess.
        """
        usual = float(np.median(self._fitness)) if self._fitness else 0.0
        limit = max(self.settings.min_fitness, self.settings.min_fitness_ratio * usual)
        doubtful = max(limit, _DOUBTFUL * usual)
        brief = self._polish_ends_it
        fit = self.fit(sweep, guess, prior, brief=brief)
        if brief and fit.matches.fitness < doubtful:
            fit = self._once_more(sweep, fit, guess, prior, doubtful)
            fit = replace(fit, surprised=True)
        if fit.matches.fitness >= doubtful:
            self._searched = 1.0
            return sweep, fit
        if limit <= fit.matches.fitness >= self._searched:
            return sweep, fit
        reason = f'{fit.matches.fitness:.0%} of the points fit the map, usual are {usual:.0%}'
        centres = [T_odom_last, guess]
        tried = self._search(sweep, centres, prior)
        if sweep.timed:  # deskewed by a motion that may have ended
            tried += self._search(self.prepare(cloud, np.zeros(6)), centres, prior)
        found_sweep, found = max(tried, key=lambda one: one[1].matches.fitness)
        if found.matches.fitness > max(limit, _BETTER * fit.matches.fitness):
            found = self.fit(found_sweep, found.T_odom_middle, prior)
            reason += f'; found by a search over headings ({found.matches.fitness:.0%})'
            return found_sweep, replace(found, reason=reason, recovered=True)
        if fit.matches.fitness >= limit:
            self._searched = _NEW * fit.matches.fitness
            return sweep, fit
        return sweep, replace(fit, T_odom_middle=guess, reason=reason, healthy=False)

    def start(self, sweep: Sweep, T_odom_middle: Array) -> None:
        """Make a sweep the first of an empty map."""
        self._kiss.add(sweep.dense, T_odom_middle)
        # All points: the surfaces of one thinned sweep are too few to register the next one well.
        self._add_surfaces(sweep.points, T_odom_middle)

    def accept(self, sweep: Sweep, fit: Fit, guess: Array) -> None:
        """Let a well registered sweep into the map."""
        if not fit.recovered and not fit.surprised:
            # KISS-ICP looks for partners as far as guesses were ever off, which slows it for good.
            self._kiss.note_deviation(guess, fit.T_odom_middle)
        self._kiss.add(sweep.dense, fit.T_odom_middle)
        self._add_surfaces(sweep.dense, fit.T_odom_middle)
        self._fitness.append(fit.matches.fitness)

    def _add_surfaces(self, points: Array, T: Array) -> None:
        self._surfaces.add(np.asarray(se3.transform_points(T, points)), T[:3, 3])
        self.sweeps += 1

    def _once_more(
        self, sweep: Sweep, fit: Fit, guess: Array, prior: Array, doubtful: float
    ) -> Fit:
        """Register anew from a turn that began or ended, and else as long as it takes."""
        turned = yaw_candidates(sweep.sample, [guess], self._surfaces, 1, _TURNS, _TURN_SPAN)[0]
        if se3.distance(guess, turned)[1] > 1e-6:
            again = self.fit(sweep, turned, prior, brief=True)
            fit = max(fit, again, key=lambda one: one.matches.fitness)
        if fit.matches.fitness >= doubtful:
            return fit
        return self.fit(sweep, fit.T_odom_middle, prior, thin=True)

    def _search(self, sweep: Sweep, centres: list[Array], prior: Array) -> list[tuple[Sweep, Fit]]:
        poses = yaw_candidates(sweep.sample, centres, self._surfaces, _HEADINGS)
        thin = self._polish_ends_it
        return [(sweep, self.fit(sweep, T, prior, rough=True, thin=thin)) for T in poses]
