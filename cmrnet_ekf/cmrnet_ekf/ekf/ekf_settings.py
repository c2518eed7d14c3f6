"""Say how the vehicle moves, how well the start is known and which observations are believed."""

from dataclasses import dataclass, field

from lcd_common.settings import config, setting


@config
class MotionConfig:
    """Noise of the inertial sensor in continuous time (data sheet), and of coasting."""

    accelerometer_noise: float = setting(
        0.02, 'accelerometer noise density', unit='m/s^2/sqrt(Hz)', low=1e-8
    )
    gyroscope_noise: float = setting(
        1e-3, 'gyroscope noise density', unit='rad/s/sqrt(Hz)', low=1e-9
    )
    accelerometer_walk: float = setting(
        1e-3, 'accelerometer bias random walk', unit='m/s^3/sqrt(Hz)', low=0.0
    )
    gyroscope_walk: float = setting(
        1e-5, 'gyroscope bias random walk', unit='rad/s^2/sqrt(Hz)', low=0.0
    )
    gravity: float = setting(9.81, 'magnitude of gravity', unit='m/s^2', low=0.0)
    estimate_biases: bool = setting(True, 'estimate gyroscope and accelerometer biases')
    imu_hold: float = setting(
        0.1,
        'an inertial sample holds at most this long, then the filter coasts',
        unit='s',
        low=1e-3,
    )
    coast_acceleration: float = setting(
        3.0, 'noise density of the velocity while coasting', unit='m/s^2/sqrt(Hz)', low=1e-6
    )
    coast_turn: float = setting(
        0.3, 'noise density of the rotation while coasting', unit='rad/s/sqrt(Hz)', low=1e-6
    )


@config
class ConstraintConfig:
    """What a ground vehicle cannot do, told to the filter at fixed times as observations."""

    nonholonomic: bool = setting(False, 'no velocity sideways or up at the rear axle')
    nonholonomic_sigma: float = setting(
        0.2, 'of the velocity sideways and up (suspension, slip)', unit='m/s', low=1e-4
    )
    axle_x: float = setting(0.0, 'rear axle before base_frame along its x axis', unit='m')
    two_d: bool = setting(False, 'keep z, roll and pitch at zero')
    two_d_sigma_z: float = setting(0.02, 'of z in two_d', unit='m', low=1e-6)
    two_d_sigma_tilt: float = setting(0.005, 'of roll and pitch in two_d', unit='rad', low=1e-6)
    period: float = setting(
        0.1, 'time between two constraints; they come with inertial samples', unit='s', low=1e-3
    )


@config
class StartConfig:
    """Standard deviations at the start; the pose's hold when none comes with it."""

    position: float = setting(1.0, 'of the position', unit='m', low=1e-6)
    rotation: float = setting(0.1, 'of the rotation', unit='rad', low=1e-6)
    velocity: float = setting(5.0, 'of the velocity', unit='m/s', low=1e-6)
    gyroscope_bias: float = setting(0.01, 'of the gyroscope bias', unit='rad/s', low=0.0)
    accelerometer_bias: float = setting(0.2, 'of the accelerometer bias', unit='m/s^2', low=0.0)


@config
class GateConfig:
    """Which observations are believed: chi-square of the innovation over its full covariance."""

    probability: float = setting(
        0.999, 'share of good observations that pass; 1: no gate', low=0.5, high=1.0
    )
    recover_after: int = setting(
        20,
        'rejections in a row of one input that agree with each other, after which the filter gives '
        'in to them, unless another pose or fix is accepted meanwhile; 0: never',
        low=0,
    )
    recover_time: float = setting(
        4.0,
        'or three of them, when the last accepted one is so long ago (slow inputs)',
        unit='s',
        low=0.1,
    )
    recover_speed: float = setting(
        3.0, 'agreeing rejections may drift apart this fast', unit='m/s', low=0.0
    )
    recover_turn: float = setting(
        0.1, 'agreeing rejections may turn apart this fast', unit='rad/s', low=0.0
    )


@config
class HistoryConfig:
    """How late observations may come, and how far ahead poses are predicted."""

    length: float = setting(
        2.0,
        'observations may come this much late; the state at their stamp is kept',
        unit='s',
        low=0.01,
    )
    max_prediction: float = setting(
        1.0, 'poses are predicted at most this far past the newest input', unit='s', low=0.0
    )


@dataclass(frozen=True)
class EkfSettings:
    """All settings of the vehicle's EKF."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    constraint: ConstraintConfig = field(default_factory=ConstraintConfig)
    start: StartConfig = field(default_factory=StartConfig)
    gate: GateConfig = field(default_factory=GateConfig)
    history: HistoryConfig = field(default_factory=HistoryConfig)
