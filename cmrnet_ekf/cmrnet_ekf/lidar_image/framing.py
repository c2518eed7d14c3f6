"""Bring images of any size to the network's, and the calibration with them."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from bags.records import CameraModel
from lcd_common.errors import DataError

# What is beside the image: the mean colour of photographs, which the network sees as 0.
PADDING = np.array([124, 116, 104], np.uint8)


class Framing:
    """Scale, crop and pad the images of one camera; the principal point moves along.

    A distortion stays as it is: it belongs to normalised coordinates.
    """

    def __init__(
        self,
        camera: CameraModel,
        width: int,
        height: int,
        *,
        focal: float = 0.0,
        centred: bool = False,
    ) -> None:
        """Plan the way from a camera's images to the network's.

        Args:
            camera: of the images.
            width, height: what the network takes, pixels.
            focal: scale so that fx becomes about that, pixels: a network knows one focal length;
                0: no scaling.
            centred: put the principal point into the middle, in whole pixels; else keep the upper
                left corner (CMRNet pads right and below).
        """
        self.source = camera
        scale = focal / float(camera.K[0, 0]) if focal else 1.0
        self._size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
        K = np.array(camera.K, np.float64)
        for axis, (size, given) in enumerate(
            zip(self._size, (camera.width, camera.height), strict=True)
        ):
            share = size / given
            K[axis, axis] *= share
            K[axis, 2] = (K[axis, 2] + 0.5) * share - 0.5
        self._left = round((width - 1) / 2 - K[0, 2]) if centred else 0
        self._top = round((height - 1) / 2 - K[1, 2]) if centred else 0
        K[:2, 2] += [self._left, self._top]
        self.camera = replace(camera, width=width, height=height, K=K)

    def image(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image [H x W x 3] for the network, from [h x w] grey or [h x w x 3] RGB.

        Raises:
            DataError: the image is not of the camera's size.
        """
        expected = self.source.height, self.source.width
        if pixels.shape[:2] != expected or pixels.shape[2:] not in ((), (3,)):
            raise DataError(
                f'expected images of {expected[1]} x {expected[0]} as the calibration says, '
                f'got the shape {pixels.shape}'
            )
        if pixels.ndim == 2:
            pixels = np.repeat(pixels[:, :, None], 3, axis=2)
        width, height = self._size
        if (height, width) != expected:
            planes = torch.from_numpy(np.array(pixels)).permute(2, 0, 1)[None].float()
            smaller = torch.nn.functional.interpolate(
                planes, (height, width), mode='bilinear', antialias=True, align_corners=False
            )
            pixels = smaller[0].permute(1, 2, 0).round().clamp(0, 255).byte().numpy()
        out = np.empty((self.camera.height, self.camera.width, 3), np.uint8)
        out[:] = PADDING
        top, left = max(self._top, 0), max(self._left, 0)
        part = pixels[max(-self._top, 0) :, max(-self._left, 0) :]
        part = part[: max(out.shape[0] - top, 0), : max(out.shape[1] - left, 0)]
        out[top : top + part.shape[0], left : left + part.shape[1]] = part
        return out
