"""Take the heading that a descriptor tells for a registration of three fewer dimensions."""

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.evaluation.descriptions import SweepDescriptor


class YawRegistration:
    """Tell heading alone, as the starred rows of the thesis's Tables 3.3 to 3.7 do."""

    yaw_only = True

    def __init__(self, descriptor: SweepDescriptor, name: str) -> None:
        self.name, self._descriptor = name, descriptor

    def prepare(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the row of a sweep."""
        return self._descriptor.row(self._descriptor.describe(cloud))

    def register(self, match: NDArray[np.float32], query: NDArray[np.float32]) -> se3.Array | None:
        """Return T_match_query without a translation; None where no heading is told."""
        _, yaw = self._descriptor.compare(query, match[None])
        return None if yaw is None else se3.rotation_z(float(yaw[0]))
