import numpy as np
import pytest
from camera_scenes import camera

from cmrnet_ekf.lidar_image.framing import PADDING, Framing
from lcd_common.errors import DataError


def test_padding_goes_right_and_below_and_moves_nothing():
    model = camera(96, 48)
    framing = Framing(model, 128, 64)
    image = np.random.default_rng(0).integers(0, 256, (48, 96, 3), np.uint8)
    framed = framing.image(image)
    np.testing.assert_array_equal(framed[:48, :96], image)
    assert (framed[48:] == PADDING).all() and (framed[:, 96:] == PADDING).all()
    np.testing.assert_array_equal(framing.camera.K, model.K)
    assert (framing.camera.width, framing.camera.height) == (128, 64)


def test_the_principal_point_moves_with_the_crop():
    model = camera(96, 48)
    framing = Framing(model, 32, 16, centred=True)
    image = np.random.default_rng(1).integers(0, 256, (48, 96, 3), np.uint8)
    framed = framing.image(image)
    shift = framing.camera.K[:2, 2] - model.K[:2, 2]
    np.testing.assert_array_equal(shift, np.round(shift))
    left, top = (-shift).astype(int)
    np.testing.assert_array_equal(framed, image[top : top + 16, left : left + 32])
    np.testing.assert_allclose(framing.camera.K[:2, 2], [15.5, 7.5], atol=0.5)


def test_a_smaller_image_shows_the_same_point_at_the_moved_place():
    """A bright blob around a pixel is found where the new calibration projects its ray."""
    model = camera(240, 120, 200.0)
    framing = Framing(model, 100, 60, focal=70.0, centred=True)
    v, u = np.mgrid[:120, :240]
    at = np.array([150.0, 70.0])
    blob = 255 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * 6.0**2))
    framed = framing.image(blob.astype(np.uint8)).astype(float)[..., 0]
    framed[framed == PADDING[0]] = 0.0
    v, u = np.mgrid[:60, :100]
    found = np.array([(framed * u).sum(), (framed * v).sum()]) / framed.sum()
    ray = np.linalg.inv(model.K) @ [*at, 1.0]
    np.testing.assert_allclose(found, (framing.camera.K @ ray)[:2], atol=0.1)
    assert framing.camera.K[0, 0] == pytest.approx(70.0, rel=0.01)


def test_grey_becomes_three_channels_and_other_sizes_are_refused():
    framing = Framing(camera(96, 48), 128, 64)
    grey = np.full((48, 96), 7, np.uint8)
    assert (framing.image(grey)[:48, :96] == 7).all()
    with pytest.raises(DataError, match='96 x 48'):
        framing.image(np.zeros((50, 96), np.uint8))
