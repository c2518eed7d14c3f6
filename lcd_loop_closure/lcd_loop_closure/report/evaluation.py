"""Compare a trajectory with its reference, by evo."""

from dataclasses import dataclass

import numpy as np
from evo import EvoException
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.trajectory import Trajectory

SEGMENTS_M = (100, 200, 300, 400, 500, 600, 700, 800)


@dataclass(frozen=True)
class TrajectoryErrors:
    """How far a trajectory is from its reference; None stands for what cannot be computed.

    Attributes:
        poses: how many poses have a reference.
        path_m: length of the reference.
        ate_rmse_m, ate_median_m, ate_max_m: absolute error after the best rigid alignment
            (Umeyama, no scale); None on a straight line, which no alignment pins down.
        ate_rotation_rmse_deg: the same alignment's rotations.
        first_pose_ate_rmse_m: absolute error with only the first poses laid on one another.
        rpe_100m_rmse_m: relative error over every 100 m of path.
        drift_percent, drift_deg_per_100m: mean over all segments of 100, 200, ... 800 m that the
            drive holds, KITTI's measure.
        end_error_m, end_error_deg: error of the last pose as seen from the first one.
        stamps_ns, errors_m: [N] the aligned error over time.
        T_truth_estimate: 4x4 that lays the estimate on the reference.
    """

    poses: int
    path_m: float
    ate_rmse_m: float | None
    ate_median_m: float | None
    ate_max_m: float | None
    ate_rotation_rmse_deg: float | None
    first_pose_ate_rmse_m: float
    rpe_100m_rmse_m: float | None
    drift_percent: float | None
    drift_deg_per_100m: float | None
    end_error_m: float
    end_error_deg: float
    stamps_ns: NDArray[np.int64]
    errors_m: NDArray[np.float64]
    T_truth_estimate: se3.Array

    def plain(self) -> dict[str, float | int | None]:
        """Return the single figures, for a JSON file."""
        left_out = ('stamps_ns', 'errors_m', 'T_truth_estimate')
        return {name: value for name, value in vars(self).items() if name not in left_out}


def trajectory_errors(estimate: Trajectory, truth: Trajectory) -> TrajectoryErrors | None:
    """Compare an estimate with its reference at the estimate's stamps.

    The reference is interpolated over gaps up to a second. Fewer than two common stamps: None.
    """
    pairs = [
        (k, T)
        for k, stamp in enumerate(estimate.stamps_ns)
        if (T := truth.at(int(stamp))) is not None
    ]
    if len(pairs) < 2:
        return None
    index = [k for k, _ in pairs]
    stamps = estimate.stamps_ns[index]
    seconds = (stamps - stamps[0]) * 1e-9
    reference = _evo(seconds, np.array([T for _, T in pairs]))
    first = _evo(seconds, estimate.T_world_body[index])
    T_first = first.align_origin(reference)
    aligned, T_aligned = _aligned(seconds, estimate.T_world_body[index], reference)
    chosen, T_truth_estimate = (first, T_first) if aligned is None else (aligned, T_aligned)
    errors = _absolute(reference, chosen)
    ate = None if aligned is None else errors
    drift = _segment_drift(reference, first)
    end_m, end_rad = se3.distance(
        se3.inverse(reference.poses_se3[0]) @ reference.poses_se3[-1],
        se3.inverse(first.poses_se3[0]) @ first.poses_se3[-1],
    )
    return TrajectoryErrors(
        poses=len(index),
        path_m=float(reference.path_length),
        ate_rmse_m=None if ate is None else _rmse(ate),
        ate_median_m=None if ate is None else float(np.median(ate)),
        ate_max_m=None if ate is None else float(ate.max()),
        ate_rotation_rmse_deg=(
            None
            if aligned is None
            else _rmse(_absolute(reference, aligned, PoseRelation.rotation_angle_deg))
        ),
        first_pose_ate_rmse_m=_rmse(_absolute(reference, first)),
        rpe_100m_rmse_m=drift[0],
        drift_percent=drift[1],
        drift_deg_per_100m=drift[2],
        end_error_m=end_m,
        end_error_deg=float(np.degrees(end_rad)),
        stamps_ns=stamps,
        errors_m=errors,
        T_truth_estimate=np.asarray(T_truth_estimate),
    )


def _evo(seconds: se3.Array, poses: se3.Array) -> PoseTrajectory3D:
    # evo aligns in place: every trajectory gets matrices of its own.
    return PoseTrajectory3D(poses_se3=[T.copy() for T in poses], timestamps=seconds)


def _aligned(
    seconds: se3.Array, poses: se3.Array, reference: PoseTrajectory3D
) -> tuple[PoseTrajectory3D | None, se3.Array]:
    estimate = _evo(seconds, poses)
    try:
        R, t, _ = estimate.align(reference)
    except EvoException:  # on a straight line or a point the rotation is free
        return None, np.eye(4)
    return estimate, se3.from_rotation_translation(R, t)


def _absolute(
    reference: PoseTrajectory3D,
    estimate: PoseTrajectory3D,
    relation: PoseRelation = PoseRelation.translation_part,
) -> NDArray[np.float64]:
    ape = APE(relation)
    ape.process_data((reference, estimate))
    return np.asarray(ape.error, dtype=np.float64)


def _segment_drift(
    reference: PoseTrajectory3D, estimate: PoseTrajectory3D
) -> tuple[float | None, float | None, float | None]:
    """Return the RMSE over 100 m, and KITTI's mean drift in percent and degrees per 100 m."""
    percent: list[float] = []
    degrees: list[float] = []
    over_100m = None
    for length in SEGMENTS_M:
        if length > reference.path_length:
            break
        rpe = RPE(
            delta=float(length), delta_unit=Unit.meters, all_pairs=True, pairs_from_reference=True
        )
        try:
            rpe.process_data((reference, estimate))
        except EvoException:  # no pair of poses lies that far apart, e.g. after long gaps
            continue
        if length == SEGMENTS_M[0]:
            over_100m = _rmse(rpe.error)
        percent += list(100.0 * rpe.error / length)
        degrees += [np.degrees(se3.rotation_angle(np.asarray(E))) * 100.0 / length for E in rpe.E]
    if not percent:
        return None, None, None
    return over_100m, float(np.mean(percent)), float(np.mean(degrees))


def _rmse(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))
