"""Measure whether the vehicle's EKF is as wrong as it says, over Monte-Carlo runs."""

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.camera_errors import GROUP, CameraErrors, camera_errors, in_closed_loop
from benchmarks.ekf_drive import ImuRecord, ReferenceDrive, reference_drive, sense
from cmrnet_ekf.ekf.consistency import anees, autocorrelation, nees
from cmrnet_ekf.ekf.ekf_settings import EkfSettings, GateConfig, MotionConfig, StartConfig
from cmrnet_ekf.ekf.observations import (
    Observation,
    PoseObservation,
    PositionObservation,
    TwistObservation,
)
from cmrnet_ekf.ekf.update import Verdict
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from lcd_common import se3

MOTION = MotionConfig(
    accelerometer_noise=0.02, gyroscope_noise=1e-3, accelerometer_walk=1e-3, gyroscope_walk=1e-5
)
START = StartConfig(
    position=0.5, rotation=0.03, velocity=0.5, gyroscope_bias=0.01, accelerometer_bias=0.1
)
CAMERA_SIGMAS = np.array([0.25, 0.12, 0.10, 0.005, 0.005, 0.008])
GNSS_SIGMAS = np.array([1.5, 1.5, 3.0])
ANTENNA = np.array([-0.5, 0.3, 1.2])
SPEED_SIGMA = 0.1
_SETTLING_S = 2.0
# What the observations in town 102 were, which validates: a mean NEES of 4.36 of 6, and whitened
# errors of neighbouring images (0.1 s) with a correlation of 0.882.
_TOLD_SCALE, _TOLD_CORRELATION_S = 4.36 / 6.0, 0.1 / -math.log(0.882)
TRACKS = 'refined_tracks.npz'  # end of the names of what the section `ekf` leaves


@dataclass
class RunRecord:
    """What one run said."""

    nees: list[float] = field(default_factory=list)
    verdicts: dict[str, list[Verdict]] = field(default_factory=lambda: defaultdict(list))


def observations(
    drive: ReferenceDrive,
    rng: np.random.Generator,
    camera: CameraErrors | None = None,
    stretch: int = 0,
) -> Iterator[Observation]:
    """Yield what camera (10 Hz), wheels (10 Hz) and GNSS (1 Hz) see, in the order of stamps."""
    seen = 0
    for k in range(0, len(drive.stamps_ns), 5):
        stamp_ns, T = int(drive.stamps_ns[k]), drive.T_map_body[k]
        if k % 10 == 0:
            xi, covariance = rng.normal(size=6) * CAMERA_SIGMAS, np.diag(CAMERA_SIGMAS**2)
            if camera is not None:
                of, at = stretch % len(camera.xi), seen % camera.xi.shape[1]
                xi, covariance = camera.xi[of, at], camera.covariances[of, at]
            seen += 1
            # T_true = T_observed exp(xi)
            yield PoseObservation(
                stamp_ns,
                'camera',
                T @ se3.exp(-xi),
                covariance,
                correlation_s=0.0 if camera is None else camera.correlation_s,
            )
        else:
            speed = (T[:3, :3].T @ drive.velocities[k])[0] + rng.normal() * SPEED_SIGMA
            yield TwistObservation(
                stamp_ns,
                'wheels',
                np.array([speed, 0, 0, 0, 0, 0]),
                SPEED_SIGMA**2 * np.eye(6),
                axes=(True, *(False,) * 5),
            )
        if k % 100 == 50:
            position = T[:3, :3] @ ANTENNA + T[:3, 3] + rng.normal(size=3) * GNSS_SIGMAS
            yield PositionObservation(stamp_ns, 'gnss', position, np.diag(GNSS_SIGMAS**2), ANTENNA)


def begun(drive: ReferenceDrive, rng: np.random.Generator, settings: EkfSettings) -> VehicleEkf:
    """Return a filter that starts off the truth by as much as it is told."""
    ekf = VehicleEkf(settings)
    s = settings.start
    sigmas = np.array([s.position] * 3 + [s.rotation] * 3)
    T = drive.T_map_body[0] @ se3.exp(-rng.normal(size=6) * sigmas)
    velocity = drive.velocities[0] + rng.normal(size=3) * s.velocity
    ekf.start(int(drive.stamps_ns[0]), T, np.diag(sigmas**2), velocity)
    return ekf


def settings(*, gate: float = 1.0) -> EkfSettings:
    """Return the filter's settings: those the drive is simulated with."""
    return EkfSettings(motion=MOTION, start=START, gate=GateConfig(probability=gate))


def imu_of(drive: ReferenceDrive, rng: np.random.Generator) -> ImuRecord:
    """Return the samples of a run."""
    return sense(
        drive,
        rng,
        noise=(MOTION.gyroscope_noise, MOTION.accelerometer_noise),
        walk=(MOTION.gyroscope_walk, MOTION.accelerometer_walk),
        bias=(START.gyroscope_bias, START.accelerometer_bias),
    )


def run_once(drive: ReferenceDrive, seed: int, camera: CameraErrors | None = None) -> RunRecord:
    """Filter one run; NEES is taken after each observation of the camera."""
    rng = np.random.default_rng(seed)
    imu = imu_of(drive, rng)
    ekf = begun(drive, rng, settings())
    record = RunRecord()
    ekf.on_verdict = lambda verdict: record.verdicts[verdict.source].append(verdict)
    coming = observations(drive, rng, camera, seed)
    following: Observation | None = next(coming)
    for k, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        ekf.add_imu(stamp_ns, imu.turn_rates[k], imu.forces[k])
        while following is not None and following.stamp_ns <= stamp_ns:
            ekf.observe(following)
            if following.source == 'camera':
                estimate = ekf.estimate()
                assert estimate is not None
                record.nees.append(
                    nees(estimate.T_map_body, estimate.covariance, drive.T_map_body[k])
                )
            following = next(coming, None)
    return record


def consistency(
    runs: int, seconds: float = 60.0, camera: CameraErrors | None = None
) -> dict[str, Any]:
    """Return ANEES, NIS and autocorrelation over runs on the same drive with other noise.

    Epochs of one drive are far from independent, so 50 runs say little about a share of epochs:
    it is the mean over groups of 50 runs, with that of each group beside it.
    """
    drive = reference_drive(seconds)
    records = [run_once(drive, seed, camera) for seed in tqdm(range(runs), unit='run')]
    values = np.array([record.nees for record in records])
    epochs = np.arange(values.shape[1]) * 0.1 >= _SETTLING_S
    groups = [anees(group) for group in _groups(values[:, epochs])]
    from_start = [anees(group).inside_share for group in _groups(values)]
    figures: dict[str, Any] = {
        'runs': runs,
        'seconds': seconds,
        'anees_band_low': groups[0].low,
        'anees_band_high': groups[0].high,
        'anees_inside_share': float(np.mean([one.inside_share for one in groups])),
        'anees_inside_share_of_groups': [one.inside_share for one in groups],
        'anees_inside_share_from_start': float(np.mean(from_start)),
        'anees_mean': float(values[:, epochs].mean()),
        'anees_mean_of_groups': [one.mean for one in groups],
    }
    for source in ('camera', 'wheels', 'gnss'):
        verdicts = [record.verdicts[source] for record in records]
        degrees = np.mean([v.dof for run in verdicts for v in run])
        figures[f'nis_{source}'] = float(np.mean([v.nis for run in verdicts for v in run]))
        figures[f'nis_{source}_expected'] = float(degrees)
        whitened = [np.array([v.whitened for v in run]) for run in verdicts]
        figures[f'autocorrelation_{source}'] = autocorrelation(whitened)
    return figures


def _groups(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Split runs into groups as large as the band is for, the last one smaller."""
    return [values[i : i + GROUP] for i in range(0, len(values), GROUP)]


def speed(samples: int = 20_000) -> dict[str, Any]:
    """Return how many inertial samples a second the filter takes, its history included.

    By processor time of one thread, for the wall clock also counts what else the machine does; and
    the best of five, by the wall clock, beside it.
    """
    drive = reference_drive(samples / 5 / 100)
    by_processor, by_wall = [], []
    for _ in range(5):
        ekf = VehicleEkf(settings())
        ekf.start(-1, drive.T_map_body[0])
        processor, wall = time.process_time(), time.perf_counter()
        for k, stamp_ns in enumerate(drive.stamps_ns.tolist()):
            ekf.add_imu(stamp_ns, drive.turn_rates[k], drive.forces[k])
        by_processor.append(len(drive.stamps_ns) / (time.process_time() - processor))
        by_wall.append(len(drive.stamps_ns) / (time.perf_counter() - wall))
    return {'imu_hz': float(np.median(by_processor)), 'imu_hz_wall_best': float(max(by_wall))}


def order_invariance(seconds: float = 10.0) -> dict[str, Any]:
    """Delay everything at random by up to a second; return how far the posteriors differ."""
    drive = reference_drive(seconds)
    imu = imu_of(drive, np.random.default_rng(0))
    items: list[tuple[int, int | Observation]] = [
        (stamp_ns, k) for k, stamp_ns in enumerate(drive.stamps_ns.tolist())
    ]
    items += [(s.stamp_ns, s) for s in observations(drive, np.random.default_rng(1))]
    delays = np.random.default_rng(2).integers(0, 1_000_000_000, len(items))
    results = []
    for order in (delays * 0, delays):
        ekf = begun(drive, np.random.default_rng(3), settings(gate=0.999))
        arrivals = sorted(range(len(items)), key=lambda i: (items[i][0] + order[i], i))
        for i in arrivals:
            item = items[i][1]
            if isinstance(item, int):
                ekf.add_imu(items[i][0], imu.turn_rates[item], imu.forces[item])
            else:
                ekf.observe(item)
        estimate = ekf.estimate()
        assert estimate is not None
        results.append(
            np.concatenate([estimate.T_map_body.ravel(), estimate.state.covariance.ravel()])
        )
    return {
        'delays_up_to_s': 1.0,
        'order_difference': float(np.abs(results[0] - results[1]).max()),
    }


def with_real_errors(camera: CameraErrors, runs: int, correlation_s: float) -> dict[str, Any]:
    """Return consistency with a camera's own errors and covariances, by what is told of them.

    Errors of one scene last: taken for independent, and for such that fade. Each run has a stretch
    of its own, as long as it lasts.
    """
    seconds = camera.xi.shape[1] * 0.1
    return {
        name: consistency(runs, seconds, replace(camera, correlation_s=told))
        for name, told in (('independent', 0.0), ('as_told', correlation_s))
    }


def section(work: Path, runs: int = 200) -> dict[str, Any]:
    """Measure everything about consistency; CMRNet's errors too where `ekf` left them."""
    from benchmarks.nodes.ekf_recovery import recoveries

    recovered = recoveries()
    figures = {
        **consistency(runs),
        **order_invariance(),
        'recovered': all(case['recovered'] for case in recovered.values()),
        'recovery': recovered,
    }
    camera = camera_errors(sorted(work.glob(f'*{TRACKS}')))
    if camera is not None:
        scaled = replace(camera, covariances=_TOLD_SCALE * camera.covariances)
        figures['with_cmrnet'] = {
            'closed_loop': in_closed_loop(camera),
            **with_real_errors(scaled, min(runs, GROUP), _TOLD_CORRELATION_S),
        }
    return {'consistency': figures, **speed()}
