"""Tie keyframes to each other by what the inertial sensor measured between them."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from lcd_common import se3
from lcd_loop_closure.imu_preintegration import ImuConfig, ImuPreintegration, ImuSample
from lcd_loop_closure.incremental_solver import IncrementalSolver

_FIRST_VELOCITY = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
_FIRST_BIAS = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([0.3, 0.03], 3))


class ImuTie:
    """Give each keyframe a velocity and a bias, and each pair of neighbours an inertial factor.

    Where measurements lack between two keyframes, the later one starts anew with a free velocity.
    """

    def __init__(self, settings: ImuConfig, T_base_imu: se3.Array) -> None:
        self._preintegration = ImuPreintegration(settings, T_base_imu)
        self._sums: dict[int, gtsam.PreintegratedCombinedMeasurements] = {}

    def add(self, sample: ImuSample) -> bool:
        """Take a sample; False when it is not finite or not newer than the last."""
        return self._preintegration.add(sample)

    def level(self, stamp_ns: int) -> se3.Array | None:
        """Return T_map_base of the first keyframe with z up; None without samples at rest."""
        return self._preintegration.level(stamp_ns)

    def collect(self, solver: IncrementalSolver, row: int, start_ns: int, end_ns: int) -> None:
        """Sum up the samples between the previous row's stamp and this row's."""
        bias = solver.bias(row - 1) if row - 1 < len(solver) else gtsam.imuBias.ConstantBias()
        total = self._preintegration.between(start_ns, end_ns, bias)
        if total is not None:
            self._sums[row] = total

    def tie(self, solver: IncrementalSolver, row: int, T_previous: se3.Array, T: se3.Array) -> None:
        """Add a row's velocity and bias, and its factor to the previous row where there is one."""
        total = self._sums.get(row)
        velocity = np.zeros(3)
        if total is not None:
            velocity = (T[:3, 3] - T_previous[:3, 3]) / total.deltaTij()
        solver.add_velocity(row, velocity)
        if total is None:
            solver.add(gtsam.PriorFactorVector(V(row), velocity, _FIRST_VELOCITY))
            zero = gtsam.imuBias.ConstantBias()
            solver.add(gtsam.PriorFactorConstantBias(B(row), zero, _FIRST_BIAS))
        else:
            keys = X(row - 1), V(row - 1), X(row), V(row), B(row - 1), B(row)
            solver.add(gtsam.CombinedImuFactor(*keys, total))
