"""Drive KITTI 00's real IMU and GPS through the ekf node, with outages, beside GTSAM's example.

The files come with GTSAM's wheel; the ground truth is KITTI's own, laid onto the GPS.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks import recordings
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.gnss import GnssDatum

# The file's GPS is in metres about an unknown place: any place does.
DATUM = GnssDatum(49.0, 8.43, 115.0)
GPS_SIGMA = 0.5
# GTSAM's example solves for the first time after so many fixes, for the heading's sake.
_FIRST_FIXES = 20
# Reference point of OXTS in the axes of the velodyne, and of that in camera 0 (KITTI's calibration
# of 2011-10-03).
_VELO_IMU = np.array([0.8105, -0.3071, 0.8027])
_CAMERA_VELO = np.array([-0.0120, -0.0540, -0.2922])
_R_CAMERA_VELO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class KittiRecording:
    """Real samples and fixes; stamps in nanoseconds of the file's clock.

    Attributes:
        imu_ns, turn_rates, forces: [N], [N x 3], [N x 3].
        gps_ns, positions: [M], [M x 3] metres, east north up.
    """

    imu_ns: NDArray[np.int64]
    turn_rates: se3.Array
    forces: se3.Array
    gps_ns: NDArray[np.int64]
    positions: se3.Array


def recording() -> KittiRecording:
    """Read the files; the dt column is not used, for its first value is wrong."""
    imu = np.loadtxt(gtsam.findExampleDataFile('KittiEquivBiasedImu.txt'), skiprows=1)
    gps_file = gtsam.findExampleDataFile('KittiGps_converted.txt')
    gps = np.loadtxt(gps_file, skiprows=1, delimiter=',')
    return KittiRecording(_ns(imu[:, 0]), imu[:, 5:8], imu[:, 2:5], _ns(gps[:, 0]), gps[:, 1:4])


def _ns(seconds: se3.Array) -> NDArray[np.int64]:
    return np.round(seconds * 1e9).astype(np.int64)


@dataclass(frozen=True)
class GroundTruth:
    """KITTI's trajectory of the IMU, laid onto the GPS by a rigid motion and a time.

    Attributes:
        times_s: [N] on the clock of the IMU.
        positions: [N x 3] in the GPS's axes.
        rms_m: of the GPS about it.
        offset_s: of the clocks.
    """

    times_s: se3.Array
    positions: se3.Array
    rms_m: float
    offset_s: float

    def at(self, stamps_ns: NDArray[np.int64]) -> se3.Array:
        """Return positions [M x 3] at stamps; NaN outside of the trajectory."""
        seconds = stamps_ns * 1e-9
        columns = [
            np.interp(seconds, self.times_s, column, left=np.nan, right=np.nan)
            for column in self.positions.T
        ]
        return np.stack(columns, axis=1)


def ground_truth(drive: KittiRecording, folder: Path | None = None) -> GroundTruth:
    """Lay KITTI's poses onto the GPS, with the time that fits best.

    Raises:
        DataError: the poses are not on this machine.
    """
    folder = folder or recordings.folder() / 'data' / 'kitti_odometry'
    poses_file, times_file = folder / 'poses' / '00.txt', folder / 'sequences' / '00' / 'times.txt'
    if not poses_file.is_file() or not times_file.is_file():
        raise DataError(f'{poses_file} and {times_file} are needed: KITTI odometry, sequence 00')
    poses = np.loadtxt(poses_file).reshape(-1, 3, 4)
    imu_camera = _R_CAMERA_VELO @ _VELO_IMU + _CAMERA_VELO
    positions = poses[:, :, :3] @ imu_camera + poses[:, :, 3]
    times = np.loadtxt(times_file)[: len(poses)]
    gps_s = drive.gps_ns * 1e-9

    def fitted(offset_s: float) -> tuple[float, se3.Array]:
        inside = (gps_s >= times[0] + offset_s) & (gps_s <= times[-1] + offset_s)
        here = np.stack(
            [np.interp(gps_s[inside] - offset_s, times, column) for column in positions.T], axis=1
        )
        T = rigid(here, drive.positions[inside])
        off = drive.positions[inside] - se3.transform_points(T, here)
        return float(np.sqrt((off**2).sum(axis=1).mean())), T

    offsets = gps_s[0] + np.arange(-5.0, 5.0, 0.1)
    best = min(offsets, key=lambda offset: fitted(offset)[0])
    best = min(best + np.arange(-0.1, 0.1, 0.01), key=lambda offset: fitted(offset)[0])
    rms_m, T = fitted(best)
    laid = np.asarray(se3.transform_points(T, positions), np.float64)
    return GroundTruth(times + best, laid, rms_m, float(best - gps_s[0]))


def rigid(a: se3.Array, b: se3.Array) -> se3.Array:
    """Return the 4x4 transform that takes points a [N x 3] onto b best (Kabsch)."""
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    U, _, Vt = np.linalg.svd((b - centre_b).T @ (a - centre_a))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.from_rotation_translation(R, centre_b - R @ centre_a)


@dataclass(frozen=True)
class Outages:
    """GPS comes for a minute, is away for a minute, and so on."""

    begin_ns: int
    on_s: float = 60.0
    off_s: float = 60.0

    def lost(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which stamps lie in an outage."""
        since = (stamps_ns - self.begin_ns) * 1e-9 % (self.on_s + self.off_s)
        return np.asarray((stamps_ns >= self.begin_ns) & (since >= self.on_s))

    def spans(self, end_ns: int) -> Iterator[tuple[int, int]]:
        """Yield begin and end of every outage; the last one may be cut off by the end."""
        period, on = (round(s * 1e9) for s in (self.on_s + self.off_s, self.on_s))
        begin = self.begin_ns + on
        while begin < end_ns:
            yield begin, min(begin + round(self.off_s * 1e9), end_ns)
            begin += period


@dataclass(frozen=True)
class Track:
    """Where a method said that the vehicle was: stamps [N], positions [N x 3]."""

    stamps_ns: NDArray[np.int64]
    positions: se3.Array


def gtsam_example(drive: KittiRecording, outages: Outages, skip: int) -> tuple[Track, Track]:
    """Run GTSAM's IMUKittiExampleGPS with outages: as it goes along, and smoothed at the end.

    Its graph, noise and order of work are those of the example; a GPS factor comes with every
    `skip`-th fix (the example: 10) that is not lost.
    """
    from gtsam.examples import IMUKittiExampleGPS as Example
    from gtsam.symbol_shorthand import B, V, X

    calibration, samples, fixes = Example.loadKittiData()
    params = Example.getImuParams(calibration)
    isam_params = gtsam.ISAM2Params()
    # The example's CHOLESKY stops in an outage: indeterminate system.
    isam_params.setFactorization('QR')
    isam_params.relinearizeSkip = 10
    isam = gtsam.ISAM2(isam_params)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    precisions, sigmas = gtsam.noiseModel.Diagonal.Precisions, gtsam.noiseModel.Diagonal.Sigmas
    gps_noise = precisions(np.array([0, 0, 0] + [1.0 / 0.07] * 3))
    pose, velocity = gtsam.Pose3(gtsam.Rot3(), fixes[1].position), np.zeros(3)
    bias = gtsam.imuBias.ConstantBias()
    lost = outages.lost(drive.gps_ns)
    stamps, track, j, included = [], [], 0, 0
    for i in range(1, len(fixes)):
        values.insert(V(i), velocity)
        values.insert(B(i), bias)
        if i == 1:
            values.insert(X(i), pose)
            graph.addPriorPose3(X(i), pose, precisions(np.array([0.0, 0, 0, 1, 1, 1])))
            graph.addPriorVector(V(i), velocity, sigmas(np.full(3, 1000.0)))
            graph.addPriorConstantBias(B(i), bias, sigmas(np.array([0.1] * 3 + [5e-5] * 3)))
            continue
        total = gtsam.PreintegratedImuMeasurements(params, bias)
        while j < len(samples) and samples[j].time <= fixes[i].time:
            if samples[j].time >= fixes[i - 1].time:
                total.integrateMeasurement(
                    samples[j].accelerometer, samples[j].gyroscope, samples[j].dt
                )
                included += 1
            j += 1
        graph.add(gtsam.ImuFactor(X(i - 1), V(i - 1), X(i), V(i), B(i - 1), total))
        walk = np.sqrt(included) * np.array(
            [calibration.accelerometer_bias_sigma] * 3 + [calibration.gyroscope_bias_sigma] * 3
        )
        still = gtsam.imuBias.ConstantBias()
        graph.add(gtsam.BetweenFactorConstantBias(B(i - 1), B(i), still, sigmas(walk)))
        if i % skip == 0 and not lost[i]:
            seen = gtsam.Pose3(pose.rotation(), fixes[i].position)
            graph.addPriorPose3(X(i), seen, gps_noise)
            values.insert(X(i), seen)
        else:
            # The example starts from the last pose; the prediction is the better start in a minute
            # without GPS.
            state = total.predict(gtsam.NavState(pose, velocity), bias)
            values.insert(X(i), state.pose() if i > 1 + _FIRST_FIXES else pose)
        if i > 1 + _FIRST_FIXES:
            isam.update(graph, values)
            graph.resize(0)
            values.clear()
            result = isam.calculateEstimate()
            pose, velocity = result.atPose3(X(i)), result.atVector(V(i))
            bias = result.atConstantBias(B(i))
            stamps.append(drive.gps_ns[i])
            track.append(pose.translation())
    result = isam.calculateEstimate()
    numbers = range(1, len(fixes))
    smoothed = np.array([result.atPose3(X(i)).translation() for i in numbers])
    return Track(np.array(stamps), np.array(track)), Track(drive.gps_ns[1:], smoothed)


def at_fixes(track: Track, drive: KittiRecording) -> Track:
    """Return the first output at or after each fix, so that all methods are asked alike."""
    k = np.searchsorted(track.stamps_ns, drive.gps_ns)
    k = k[k < len(track.stamps_ns)]
    return Track(track.stamps_ns[k], track.positions[k])


def scores(track: Track, truth: GroundTruth, outages: Outages) -> dict[str, Any]:
    """Return horizontal errors with GPS, in outages and at their ends, metres."""
    where = truth.at(track.stamps_ns)
    off = np.linalg.norm((track.positions - where)[:, :2], axis=1)
    known, lost = np.isfinite(off), outages.lost(track.stamps_ns)
    # Not before the first minute's third, and a few fixes after an outage.
    since = (track.stamps_ns - outages.begin_ns) * 1e-9
    settled = (since > 20.0) & (since % (outages.on_s + outages.off_s) > 5.0)
    figures: dict[str, Any] = {
        'with_gps_mean_m': float(off[known & ~lost & settled].mean()),
        'with_gps_p95_m': float(np.percentile(off[known & ~lost & settled], 95)),
        'outage_mean_m': float(off[known & lost].mean()),
        'outage_max_m': float(off[known & lost].max()),
    }
    ends = []
    for begin_ns, end_ns in outages.spans(int(track.stamps_ns[-1])):
        inside = known & (track.stamps_ns > begin_ns) & (track.stamps_ns <= end_ns)
        if inside.any():
            ends.append(float(off[inside][-1]))
    figures['outage_end_m'] = ends
    return figures


def section(work: Path) -> dict[str, Any]:
    """Run all methods over the drive and draw their tracks into `work`."""
    from benchmarks.nodes.ekf_replay import replay

    drive = recording()
    truth, outages = ground_truth(drive), Outages(int(drive.gps_ns[1]))
    wheels: dict[str, object] = {'constraint__nonholonomic': True}
    variants: dict[str, dict[str, object]] = {
        'ekf': wheels,
        'without_biases': {**wheels, 'motion__estimate_biases': False},
        'without_nonholonomic': {},
        'without_frozen_check': {**wheels, 'frozen_imu': 0},
    }
    tracks: dict[str, Track] = {}
    figures: dict[str, Any] = {
        'gps_rms_about_truth_m': truth.rms_m,
        'clock_offset_s': truth.offset_s,
        'outage_s': outages.off_s,
        'gps_alone': {
            'with_gps_mean_m': scores(Track(drive.gps_ns, drive.positions), truth, outages)[
                'with_gps_mean_m'
            ]
        },
    }
    for name, parameters in variants.items():
        track, counts = replay(drive, outages, **parameters)
        tracks[name] = at_fixes(track, drive)
        figures[name] = scores(tracks[name], truth, outages)
        figures[name]['gps_rejected'] = counts.get('gps rejected: outlier', 0)
        figures[name]['imu_samples_frozen'] = counts.get('imu samples frozen', 0)
    for name, skip in (('gtsam_every_fix', 1), ('gtsam', 10)):
        tracks[name], smoothed = gtsam_example(drive, outages, skip)
        figures[name] = scores(tracks[name], truth, outages)
        figures[f'{name}_smoothed'] = scores(smoothed, truth, outages)
    draw(work / 'kitti_00.png', tracks, truth, outages)
    return figures


def draw(path: Path, tracks: dict[str, Track], truth: GroundTruth, outages: Outages) -> None:
    """Draw tracks over the ground truth and errors over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.5), layout='constrained')
    left, right = figure.subplots(1, 2)
    left.plot(*truth.positions[:, :2].T, color='0.75', lw=4, label='ground truth')
    shown = ('gtsam_every_fix', 'without_biases', 'ekf')
    for name in shown:
        track = tracks[name]
        where = truth.at(track.stamps_ns)
        off = np.linalg.norm((track.positions - where)[:, :2], axis=1)
        seconds = (track.stamps_ns - outages.begin_ns) * 1e-9
        line = right.plot(seconds, off, label=name.replace('_', ' '), lw=1.2)[0]
        left.plot(*track.positions[:, :2].T, color=line.get_color(), lw=1, label=line.get_label())
    low, high = truth.positions[:, :2].min(axis=0) - 60, truth.positions[:, :2].max(axis=0) + 60
    left.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel='east [m]', ylabel='north [m]')
    left.set_aspect('equal')
    left.set_title('KITTI 00: real IMU and GPS, the GPS away every other minute')
    end_ns = int(max(track.stamps_ns[-1] for track in tracks.values()))
    for begin, end in outages.spans(end_ns):
        span = [(stamp - outages.begin_ns) * 1e-9 for stamp in (begin, end)]
        right.axvspan(*span, color='0.9', label='without GPS' if span[0] < 61.0 else None)
    right.set(yscale='log', ylim=(0.05, 2000), xlabel='time [s]', ylabel='horizontal error [m]')
    right.legend(loc='upper left')
    left.legend(loc='lower right')
    figure.savefig(path, dpi=110)
