"""Say which inputs the EKF takes and read their messages."""

import numpy as np
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from sensor_msgs.msg import Imu

from cmrnet_ekf.ekf.covariance_check import used_covariance
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.nodes import messages
from lcd_common.settings import config, setting

_NAMES = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')


@config
class PoseInputConfig:
    """A pose of base_frame in world_frame (geometry_msgs/PoseWithCovarianceStamped)."""

    topic: str = setting('camera_pose', 'its topic')
    axes: str = setting('x y z roll pitch yaw', 'axes of world_frame that count')
    sigma_position: float = setting(
        0.0, 'instead of the covariance that comes with it; 0: that one', unit='m', low=0.0
    )
    sigma_rotation: float = setting(
        0.0, 'instead of the covariance that comes with it; 0: that one', unit='rad', low=0.0
    )
    covariance_scale: float = setting(
        1.0,
        'factor on its covariance; track_cmrnet --ekf camera_scale=... shows the NEES',
        low=1e-6,
    )
    correlation_time: float = setting(
        1.0,
        'errors fade in this time, and count the less: those against a map last while the scene '
        'does; 0: independent',
        unit='s',
        low=0.0,
    )
    timeout: float = setting(1.0, 'WARN when it is silent for longer', unit='s', low=0.01)


@config
class OdometryInputConfig:
    """Odometry (nav_msgs/Odometry): what moves it counts, its origin does not."""

    topic: str = setting('odom', 'its topic')
    use: str = setting(
        'motion',
        'the motion between two messages, the twist, both, or nothing but map -> odom',
        choices=('motion', 'twist', 'both', 'nothing'),
    )
    axes: str = setting('x y z roll pitch yaw', 'axes of the vehicle that count')
    sigma_position: float = setting(
        0.0, 'of a motion, instead of the growth of the covariance; 0: that one', unit='m', low=0.0
    )
    sigma_rotation: float = setting(
        0.0,
        'of a motion, instead of the growth of the covariance; 0: that one',
        unit='rad',
        low=0.0,
    )
    correlation_time: float = setting(
        0.0, 'errors fade in this time, and count the less; 0: independent', unit='s', low=0.0
    )
    timeout: float = setting(1.0, 'WARN when it is silent for longer', unit='s', low=0.01)


@config
class TwistInputConfig:
    """A twist in its own frame (geometry_msgs/TwistWithCovarianceStamped): wheels, radar."""

    topic: str = setting('twist', 'its topic')
    axes: str = setting('x', 'axes of the frame that count')
    correlation_time: float = setting(
        0.0, 'errors fade in this time, and count the less; 0: independent', unit='s', low=0.0
    )
    timeout: float = setting(1.0, 'WARN when it is silent for longer', unit='s', low=0.01)


@config
class FixInputConfig:
    """Satellite fixes (sensor_msgs/NavSatFix) of an antenna that /tf_static knows."""

    topic: str = setting('gps/fix', 'its topic')
    axes: str = setting('x y z', 'axes of world_frame that count')
    minimum_sigma: float = setting(
        0.5, 'no fix is believed to be better than this', unit='m', low=1e-3
    )
    maximum_sigma: float = setting(20.0, 'fixes worse than this are not used', unit='m', low=0.1)
    correlation_time: float = setting(
        0.0, 'errors fade in this time, and count the less; 0: independent', unit='s', low=0.0
    )
    timeout: float = setting(3.0, 'WARN when it is silent for longer', unit='s', low=0.01)


def axes_of(text: str, count: int, what: str) -> tuple[bool, ...]:
    """Read axes named in a parameter; raises ConfigError when one is unknown or there is none."""
    names, known = text.split(), _NAMES[:count]
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ConfigError(f'{what}.axes must name some of {" ".join(known)}, got {text!r}')
    return tuple(name in names for name in known)


def imu_sample(message: Imu) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return turn rate and specific force [3]; DataError when the driver says it has none."""
    if message.angular_velocity_covariance[0] < 0 or message.linear_acceleration_covariance[0] < 0:
        raise DataError('imu: the driver says that it gives no turn rate or no acceleration (-1)')
    turn, force = message.angular_velocity, message.linear_acceleration
    return np.array((turn.x, turn.y, turn.z)), np.array((force.x, force.y, force.z))


def pose_covariance(
    T: se3.Array,
    ros_covariance: object,
    sigmas: tuple[float, float],
    axes: tuple[bool, ...],
    what: str,
) -> se3.Array:
    """Return a pose's 6x6 covariance in body axes, from sigmas or from a message.

    Args:
        T: the pose.
        ros_covariance: the message's 36 numbers, in the axes of the parent.
        sigmas: of position and rotation, m and rad; zeros: the message's covariance.
        axes: which rows count; the others may hold anything.
        what: the input, for people.

    Raises:
        DataError: the covariance is none.
    """
    covariance = np.asarray(ros_covariance, np.float64).reshape(6, 6)
    position, rotation = sigmas
    if position or rotation:
        if not (position and rotation):
            raise DataError(f'{what}: set sigma_position and sigma_rotation, or neither')
        covariance = np.diag([position**2] * 3 + [rotation**2] * 3)
    return se3.covariance_from_ros(T, used_covariance(covariance, np.array(axes), what))


def stated_covariance(ros_covariance: object, position: float, rotation: float) -> se3.Array:
    """Return 36 numbers [6 x 6] with the variances of axes of which nothing is said, m and rad.

    RViz's click says nothing of z, roll and pitch: zeros in their rows and columns.
    """
    covariance = np.array(ros_covariance, np.float64).reshape(6, 6)
    unsaid = ~(covariance.any(axis=0) | covariance.any(axis=1))
    variances = np.square([position] * 3 + [rotation] * 3)
    covariance[unsaid, unsaid] = variances[unsaid]
    return covariance


def twist_vector(message: Twist) -> NDArray[np.float64]:
    """Return linear and angular velocity [6]."""
    v, w = message.linear, message.angular
    return np.array([v.x, v.y, v.z, w.x, w.y, w.z])


def odometry_growth(message: Odometry) -> tuple[se3.Array, se3.Array | None]:
    """Return an odometry's pose and its covariance in body axes; None where that is none."""
    try:
        return messages.from_pose_with_covariance(message.pose)
    except DataError:
        return messages.transform_from_pose(message.pose.pose), None
