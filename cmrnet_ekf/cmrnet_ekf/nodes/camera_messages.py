"""Convert images and calibrations between ROS and numpy."""

import array

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from bags.records import CameraModel
from lcd_common.errors import DataError
from lcd_common.nodes import messages

Pixels = NDArray[np.uint8]
# Channels of an encoding, and which of them are red, green and blue.
_ENCODINGS = {
    'mono8': (1, (0,)),
    '8UC1': (1, (0,)),
    'rgb8': (3, (0, 1, 2)),
    'bgr8': (3, (2, 1, 0)),
    '8UC3': (3, (2, 1, 0)),
    'rgba8': (4, (0, 1, 2)),
    'bgra8': (4, (2, 1, 0)),
}


def image_from_message(message: Image) -> Pixels:
    """Return an image [H x W] grey or [H x W x 3] RGB.

    Raises:
        DataError: the encoding is another, or the data do not fit the size.
    """
    if message.encoding not in _ENCODINGS:
        raise DataError(
            f'expected an image as one of {", ".join(_ENCODINGS)}, got {message.encoding!r}'
        )
    channels, order = _ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(message.data, np.uint8)
    if height < 1 or step < width * channels or len(data) < height * step:
        raise DataError(
            f'an image of {width} x {height} in {message.encoding} with {step} bytes a row needs '
            f'{height * max(step, width * channels)} bytes, got {len(data)}'
        )
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    if channels == 1:
        return rows
    return rows.reshape(height, width, channels)[:, :, list(order)]


def image_message(pixels: Pixels, stamp_ns: int, frame_id: str) -> Image:
    """Make an rgb8 image of [H x W x 3]."""
    data = array.array('B')
    data.frombytes(np.ascontiguousarray(pixels).data)
    return Image(
        header=messages.header(stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding='rgb8',
        step=3 * pixels.shape[1],
        data=data,
    )


def camera_from_message(message: CameraInfo) -> CameraModel:
    """Return the calibration of raw images.

    Raises:
        DataError: the distortion is not plumb_bob's, or the image is binned or cut.
    """
    if message.distortion_model not in ('', 'plumb_bob'):
        raise DataError(
            f'expected the distortion model plumb_bob, got {message.distortion_model!r}; '
            'rectify the images and publish their camera_info'
        )
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width or message.roi.height:
        raise DataError('expected camera_info of whole images, without binning and roi')
    distortion = tuple(float(v) for v in message.d) or (0.0,) * 5
    return CameraModel(
        message.header.frame_id,
        message.width,
        message.height,
        np.array(message.k, np.float64).reshape(3, 3),
        distortion,
    )
