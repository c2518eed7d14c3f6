import numpy as np
import pytest
from camera_scenes import camera

from cmrnet_ekf.lidar_image.lens import distorted, make_lens
from lcd_common.errors import DataError

BARREL = (-0.35, 0.15, 0.001, -0.0005, -0.02)


def test_a_straight_lens_sees_along_the_inverse_camera_matrix():
    model = camera()
    rays = make_lens(model).rays
    expected = np.linalg.inv(model.K) @ [10, 20, 1]
    np.testing.assert_allclose(rays[20, 10], expected[:2], atol=1e-6)


def test_distorting_the_rays_leads_back_to_the_pixels():
    model = camera(distortion=BARREL)
    bent = distorted(make_lens(model).rays.astype(float), np.array(BARREL))
    u = bent[..., 0] * model.K[0, 0] + model.K[0, 2]
    v = bent[..., 1] * model.K[1, 1] + model.K[1, 2]
    np.testing.assert_allclose(u, np.tile(np.arange(model.width), (model.height, 1)), atol=1e-3)
    np.testing.assert_allclose(v, np.tile(np.arange(model.height)[:, None], (1, 96)), atol=1e-3)


def test_the_fold_is_where_the_radius_stops_growing():
    lens = make_lens(camera(distortion=(-0.4, 0.0, 0.0, 0.0, 0.0)))
    radius = np.linspace(0, 2, 20001)
    lands = np.linalg.norm(
        distorted(np.stack([radius, 0 * radius], 1), np.array([-0.4, 0, 0, 0, 0])), axis=1
    )
    growing = np.diff(lands) > 0
    assert np.sqrt(lens.max_radius_squared) == pytest.approx(radius[np.argmin(growing)], abs=1e-3)
    assert make_lens(camera()).max_radius_squared == np.inf


@pytest.mark.parametrize(
    'broken',
    [
        camera(focal=-1.0),
        camera(focal=float('nan')),
        camera(distortion=(0.1,) * 8),
        camera(width=0),
    ],
)
def test_what_is_no_pinhole_is_refused(broken):
    with pytest.raises(DataError, match='expected'):
        make_lens(broken)
