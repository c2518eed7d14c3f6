"""Move and correct a vehicle in a tracking run: by the thesis's filter, or by the suite's own."""

import numpy as np

from cmrnet_ekf import euler
from cmrnet_ekf.ekf.consistency import nees
from cmrnet_ekf.ekf.ekf_settings import ConstraintConfig, EkfSettings, StartConfig
from cmrnet_ekf.ekf.observations import PoseObservation, TwistObservation
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive
from cmrnet_ekf.thesis_ekf import ThesisEkf, ThesisEkfConfig, pose_vector, wrapped
from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting

_AHEAD = (True, *(False,) * 5)
_CAMERA, _WHEELS = 'camera', 'wheels'
_SETTINGS = EkfSettings(
    constraint=ConstraintConfig(nonholonomic=True),
    # Of errors that are uniform within 2 m and 10 degrees.
    start=StartConfig(position=1.15, rotation=0.1, velocity=1.0),
)


class ThesisTracking:
    """Algorithm 2 of the thesis: the gyroscope's turn rate and the wheels move the filter."""

    def __init__(self, drive: TrackingDrive, T_map_base: se3.Array) -> None:
        self._drive = drive
        self._ekf = ThesisEkf(ThesisEkfConfig(), T_map_base)

    @property
    def T_map_base(self) -> se3.Array:
        """Pose at the image that it moved to last."""
        return self._ekf.T_map_base

    @property
    def covariance(self) -> se3.Array:
        """Covariance 6x6 of the pose, body axes of base (the thesis's: of x y z roll pitch yaw)."""
        return self._ekf.covariance

    def nees(self, T_map_base_true: se3.Array) -> float:
        """Return the normalised estimation error squared of the pose: 6 on average when right."""
        error = wrapped(pose_vector(T_map_base_true) - pose_vector(self.T_map_base))
        return float(error @ np.linalg.solve(self.covariance, error))

    def move(self, k: int, speed_mps: float) -> None:
        """Move from image k - 1 to image k; the wheels say how fast."""
        stamps_ns = self._drive.stamps_ns
        dt_s = float(stamps_ns[k] - stamps_ns[k - 1]) * 1e-9
        self._ekf.predict(speed_mps, float(self._drive.turn_rates_radps[k]), dt_s)

    def correct(self, k: int, T_map_base: se3.Array, covariance: se3.Array) -> None:
        """Correct by what the camera says at image k; covariance 6x6 in body axes of base."""
        self._ekf.update(T_map_base, component_covariance(T_map_base, covariance))


@config
class VehicleTrackingConfig:
    """What the vehicle's EKF is told of its inputs; chosen on a validation town."""

    camera_correlation: float = setting(
        1.0, 'errors of camera poses fade in this time', unit='s', low=0.0
    )
    camera_scale: float = setting(1.0, 'factor on the covariances of camera poses', low=1e-3)
    wheel_sigma: float = setting(0.15, 'of the speed by the wheels', unit='m/s', low=1e-3)
    wheel_correlation: float = setting(
        1.0, 'errors of the wheels fade in this time', unit='s', low=0.0
    )


class VehicleTracking:
    """The vehicle's EKF: inertial samples move it, wheels and camera correct it."""

    def __init__(
        self,
        drive: TrackingDrive,
        T_map_base: se3.Array,
        speed_mps: float,
        settings: VehicleTrackingConfig,
    ) -> None:
        """Start at the first image, at a pose, as fast as the wheels say.

        Raises:
            ConfigError: the drive has no inertial sensor.
        """
        if drive.imu is None:
            raise ConfigError(
                f"{drive.name}: the vehicle's EKF needs inertial samples, and there are none: use "
                "the thesis's filter; frames recorded by an older version lack them, remove these"
            )
        self._drive, self._imu, self._settings = drive, drive.imu, settings
        self._T_imu_base = se3.inverse(self._imu.T_base_imu)
        self._ekf = VehicleEkf(_SETTINGS, self._T_imu_base)
        T_map_imu = T_map_base @ self._imu.T_base_imu
        start_ns = int(drive.stamps_ns[0])
        self._ekf.start(start_ns, T_map_imu, velocity_map=T_map_base[:3, 0] * speed_mps)
        self._next = int(np.searchsorted(self._imu.stamps_ns, start_ns))

    @property
    def T_map_base(self) -> se3.Array:
        """See `ThesisTracking`."""
        estimate = self._ekf.estimate()
        assert estimate is not None
        return estimate.T_map_body @ self._T_imu_base

    @property
    def covariance(self) -> se3.Array:
        """See `ThesisTracking`."""
        estimate = self._ekf.estimate()
        assert estimate is not None
        Ad = se3.adjoint(self._imu.T_base_imu)
        return np.asarray(Ad @ estimate.covariance @ Ad.T, np.float64)

    def nees(self, T_map_base_true: se3.Array) -> float:
        """See `ThesisTracking`."""
        return nees(self.T_map_base, self.covariance, T_map_base_true)

    def move(self, k: int, speed_mps: float) -> None:
        """See `ThesisTracking`."""
        imu, s, stamp_ns = self._imu, self._settings, int(self._drive.stamps_ns[k])
        while self._next < len(imu.stamps_ns) and imu.stamps_ns[self._next] <= stamp_ns:
            at = self._next
            self._ekf.add_imu(int(imu.stamps_ns[at]), imu.turn_rates[at], imu.forces[at])
            self._next += 1
        twist = np.array([speed_mps, 0, 0, 0, 0, 0])
        covariance = s.wheel_sigma**2 * np.eye(6)
        self._ekf.observe(
            TwistObservation(
                stamp_ns, _WHEELS, twist, covariance, self._T_imu_base, _AHEAD, s.wheel_correlation
            )
        )

    def correct(self, k: int, T_map_base: se3.Array, covariance: se3.Array) -> None:
        """See `ThesisTracking`."""
        s = self._settings
        self._ekf.observe(
            PoseObservation(
                int(self._drive.stamps_ns[k]), _CAMERA, T_map_base, s.camera_scale * covariance,
                self._T_imu_base, correlation_s=s.camera_correlation,
            )
        )  # fmt: skip


def component_covariance(T_map_base: se3.Array, covariance: se3.Array) -> se3.Array:
    """Return the covariance of x y z roll pitch yaw, of one in body axes (translation first)."""
    J = np.linalg.inv(euler.jacobian_to_body(euler.components(T_map_base)))
    out = J @ covariance @ J.T
    return np.asarray(0.5 * (out + out.T), np.float64)
