"""Read odometry of any source."""

from nav_msgs.msg import Odometry

from lcd_common.errors import DataError
from lcd_common.nodes import messages
from lcd_common.stamp_buffer import StampedPose


def odometry_pose(message: Odometry) -> StampedPose:
    """Return stamp, pose and body-axes covariance of an Odometry message.

    A covariance that is none (zeros, not positive definite, NaN) is unknown: odometry without one
    is common, and its poses are still good.

    Raises:
        DataError: the pose is broken.
    """
    stamp_ns = messages.stamp_ns(message.header.stamp)
    try:
        T_odom_base, covariance = messages.from_pose_with_covariance(message.pose)
    except DataError:
        T_odom_base, covariance = messages.transform_from_pose(message.pose.pose), None
    return StampedPose(stamp_ns, T_odom_base, covariance)
