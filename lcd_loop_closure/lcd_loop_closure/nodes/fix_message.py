"""Read satellite fixes."""

import numpy as np
from sensor_msgs.msg import NavSatFix, NavSatStatus

from lcd_common.errors import DataError
from lcd_common.nodes import messages
from lcd_loop_closure.gnss import GnssFix


def fix_from_message(message: NavSatFix) -> GnssFix:
    """Read a NavSatFix.

    Raises:
        DataError: the receiver has no fix, or does not say how good it is.
    """
    if message.status.status < NavSatStatus.STATUS_FIX:
        raise DataError('the receiver has no fix')
    if message.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN:
        raise DataError('a fix must come with its covariance; this one has the type unknown')
    return GnssFix(
        messages.stamp_ns(message.header.stamp),
        float(message.latitude),
        float(message.longitude),
        float(message.altitude),
        np.asarray(message.position_covariance, np.float64).reshape(3, 3),
    )
