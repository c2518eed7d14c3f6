"""Make LiDAR images of one camera, wherever that is fastest."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from bags.records import CameraModel
from cmrnet_ekf.lidar_image import on_torch
from cmrnet_ekf.lidar_image.lens import make_lens
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from lcd_common import se3


class LidarImager:
    """Turn points into what a camera would see of them: a depth image without hidden surfaces."""

    def __init__(
        self,
        camera: CameraModel,
        settings: LidarImageConfig | None = None,
        device: torch.device | str = 'cpu',
    ) -> None:
        """Prepare for a camera.

        Args:
            camera: of the image as the network takes it (cropped, padded, scaled).
            settings: of the image.
            device: the processor uses numba, other devices torch; the pixels are the same.
        """
        self.settings = settings or LidarImageConfig()
        self.lens = make_lens(camera)
        self.device = torch.device(device)

    def image(
        self, points: NDArray[np.float32] | torch.Tensor, T_camera_points: se3.Array
    ) -> torch.Tensor:
        """Return the depth image [H x W], float32 metres, 0 where nothing is seen.

        Args:
            points: [N x 3] float32; a tensor stays where it is.
            T_camera_points: from the points' frame to the camera's optical frame (z forward).
        """
        if self.device.type == 'cpu':
            from cmrnet_ekf.lidar_image import on_cpu  # numba: where it is not needed it may lack

            xyz = points.numpy() if isinstance(points, torch.Tensor) else points
            depth = on_cpu.depth_image(xyz, T_camera_points, self.lens, self.settings)
            return torch.from_numpy(on_cpu.without_hidden(depth, self.lens, self.settings))
        points = torch.as_tensor(points, device=self.device)
        T = torch.from_numpy(np.asarray(T_camera_points, np.float32))
        image = on_torch.depth_image(points, T, self.lens, self.settings)
        return on_torch.without_hidden(image, self.lens, self.settings)

    def images(
        self,
        points: Sequence[NDArray[np.float32] | torch.Tensor],
        T_camera_points: Sequence[se3.Array],
    ) -> torch.Tensor:
        """Return the images [B x H x W] of several clouds or poses."""
        return torch.stack([self.image(p, T) for p, T in zip(points, T_camera_points, strict=True)])
