"""Tell the filter what a ground vehicle cannot do, at fixed times."""

import numpy as np

from cmrnet_ekf.ekf.ekf_settings import ConstraintConfig
from cmrnet_ekf.ekf.motion_state import MotionState
from cmrnet_ekf.ekf.observations import PoseObservation, TwistObservation
from cmrnet_ekf.ekf.update import Update
from lcd_common import se3

_SIDEWAYS_AND_UP = (False, True, True, False, False, False)
_HEIGHT_AND_TILT = (False, False, True, True, True, False)


class Constraints:
    """Apply them with the first inertial sample of each period of the clock.

    The times belong to the stamps, so that they do not depend on what comes when.
    """

    def __init__(self, settings: ConstraintConfig, T_body_base: se3.Array, update: Update) -> None:
        self.settings = settings
        self._period_ns = round(settings.period * 1e9)
        self._wanted = settings.nonholonomic or settings.two_d
        self._T_body_base = T_body_base
        axle = se3.from_rotation_translation(np.eye(3), [settings.axle_x, 0.0, 0.0])
        self._T_body_axle = T_body_base @ axle
        self._update = update

    def due(self, before_ns: int, now_ns: int) -> bool:
        """Tell whether a period began between two inertial samples."""
        return self._wanted and before_ns // self._period_ns != now_ns // self._period_ns

    def hold(self, state: MotionState) -> MotionState:
        """Return the state after the constraints."""
        s = self.settings
        if s.nonholonomic:
            still = TwistObservation(
                state.stamp_ns,
                'nonholonomic',
                np.zeros(6),
                s.nonholonomic_sigma**2 * np.eye(6),
                self._T_body_axle,
                _SIDEWAYS_AND_UP,
            )
            state, _ = self._update(state, still)
        if s.two_d:
            T_map_base = state.T_map_body @ self._T_body_base
            flat = se3.rotation_z(se3.yaw(T_map_base))
            flat[:2, 3] = T_map_base[:2, 3]
            tilt, z = s.two_d_sigma_tilt**2, s.two_d_sigma_z**2
            level = PoseObservation(
                state.stamp_ns,
                'two_d',
                flat,
                np.diag([z, z, z, tilt, tilt, tilt]),
                self._T_body_base,
                _HEIGHT_AND_TILT,
            )
            state, _ = self._update(state, level)
        return state
