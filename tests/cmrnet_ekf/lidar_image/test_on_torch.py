import numpy as np
import pytest
import torch
from camera_scenes import T_OPTICAL_BODY, camera, street

from cmrnet_ekf.lidar_image import on_cpu, on_torch
from cmrnet_ekf.lidar_image.imager import LidarImager
from cmrnet_ekf.lidar_image.lens import make_lens
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from lcd_common import se3


@pytest.mark.parametrize('distortion', [(0.0,) * 5, (-0.3, 0.1, 0.001, -0.0005, 0.02)])
@pytest.mark.parametrize('threshold', [3.0, 3.9999])
def test_both_make_the_same_pixels(distortion, threshold):
    settings = LidarImageConfig(threshold=threshold)
    lens = make_lens(camera(300, 150, 200.0, distortion))
    rng = np.random.default_rng(0)
    points = street(rng)
    T = T_OPTICAL_BODY @ se3.exp(rng.normal(0, 0.1, 6))
    one = on_cpu.depth_image(points, T, lens, settings)
    other = on_torch.depth_image(torch.from_numpy(points), torch.from_numpy(T), lens, settings)
    np.testing.assert_array_equal(one, other.numpy())
    np.testing.assert_array_equal(
        on_cpu.without_hidden(one, lens, settings),
        on_torch.without_hidden(other, lens, settings).numpy(),
    )


def test_a_batch_is_filtered_as_its_images_are():
    lens, settings = make_lens(camera()), LidarImageConfig()
    rng = np.random.default_rng(1)
    images = [
        torch.from_numpy(on_cpu.depth_image(street(rng), T_OPTICAL_BODY, lens, settings))
        for _ in range(2)
    ]
    batch = on_torch.without_hidden(torch.stack(images), lens, settings)
    for image, filtered in zip(images, batch, strict=True):
        assert torch.equal(on_torch.without_hidden(image, lens, settings), filtered)


def test_the_imager_filters_what_it_projects():
    imager, rng = LidarImager(camera()), np.random.default_rng(2)
    points = street(rng)
    image = imager.image(points, T_OPTICAL_BODY)
    depth = on_cpu.depth_image(points, T_OPTICAL_BODY, imager.lens, imager.settings)
    np.testing.assert_array_equal(
        image.numpy(), on_cpu.without_hidden(depth, imager.lens, imager.settings)
    )
    pair = imager.images([points, torch.from_numpy(points)], [T_OPTICAL_BODY, T_OPTICAL_BODY])
    assert torch.equal(pair[0], image) and torch.equal(pair[1], image)


def test_no_points_make_an_empty_image():
    assert not LidarImager(camera()).image(np.empty((0, 3), np.float32), T_OPTICAL_BODY).any()
