"""Check LiDAR images against loops that do what the definition says."""

import numpy as np
import pytest
from camera_scenes import T_OPTICAL_BODY, camera, ground, street, wall

from cmrnet_ekf.lidar_image.lens import distorted, make_lens
from cmrnet_ekf.lidar_image.on_cpu import depth_image, without_hidden
from cmrnet_ekf.lidar_image.settings import LidarImageConfig

BARREL = (-0.3, 0.1, 0.001, -0.0005, 0.0)


@pytest.mark.parametrize('distortion', [(0.0,) * 5, BARREL])
def test_each_pixel_has_the_nearest_point_that_falls_into_it(distortion):
    model, settings = camera(distortion=distortion), LidarImageConfig(max_depth=40.0)
    points = street(np.random.default_rng(0))
    seen = depth_image(points, T_OPTICAL_BODY, make_lens(model), settings)

    p = points.astype(float) @ T_OPTICAL_BODY[:3, :3].T
    p = p[(p[:, 2] >= 0.5) & (p[:, 2] <= 40.0)]
    xy = distorted(p[:, :2] / p[:, 2:], np.array(distortion))
    pixel = xy * np.diag(model.K)[:2] + model.K[:2, 2]
    expected = np.full((model.height, model.width), np.inf)
    for (u, v), z in zip(np.rint(pixel).astype(int), p[:, 2], strict=True):
        if 0 <= u < model.width and 0 <= v < model.height:
            expected[v, u] = min(expected[v, u], z)
    expected[np.isinf(expected)] = 0.0
    # A point on the border of two pixels may fall into either, as rounding goes.
    agree = np.isclose(seen, expected, rtol=1e-5)
    assert agree.mean() > 0.999
    assert (seen > 0).mean() > 0.3


def test_what_a_lens_would_fold_into_the_image_is_not_seen():
    model = camera(distortion=(-0.4, 0.0, 0.0, 0.0, 0.0))
    aside = np.array([[1.0, -2.5, 0.0]], np.float32)  # folds back to x = -3.75 ... of 1 m ahead
    assert not depth_image(aside, T_OPTICAL_BODY, make_lens(model), LidarImageConfig()).any()


def brute_force(depth, model, radius, threshold):
    height, width = depth.shape
    inverse = np.linalg.inv(model.K)

    def point(v, u):
        return depth[v, u] * (inverse @ [u, v, 1.0])

    out = np.zeros_like(depth)
    for v, u in np.argwhere(depth > 0):
        p, total = point(v, u), 0.0
        for down in (-1, 1):
            for right in (-1, 1):
                best = -1.0
                for i in range(radius + 1):
                    for j in range(radius + 1):
                        row, column = v + down * i, u + right * j
                        inside = 0 <= row < height and 0 <= column < width
                        if (i or j) and inside and depth[row, column] > 0:
                            d = point(row, column) - p
                            cosine = -d @ p / np.linalg.norm(d) / np.linalg.norm(p)
                            best = max(best, cosine)
                total += best
        if total < threshold:
            out[v, u] = depth[v, u]
    return out


@pytest.mark.parametrize(('radius', 'threshold'), [(5, 3.0), (5, 3.7), (2, 2.0)])
def test_the_filter_does_what_its_definition_says(radius, threshold):
    model = camera(48, 24, 40.0)
    settings = LidarImageConfig(radius=radius, threshold=threshold)
    lens = make_lens(model)
    depth = depth_image(street(np.random.default_rng(1))[::3], T_OPTICAL_BODY, lens, settings)
    expected = brute_force(depth.astype(float), model, radius, threshold)
    seen = without_hidden(depth, lens, settings)
    assert (np.isclose(seen, expected, rtol=1e-5)).mean() > 0.995
    assert 0 < (expected > 0).sum() < (depth > 0).sum()


def test_a_wall_hides_the_wall_behind_it():
    lens = make_lens(camera(400, 300, 400.0))
    near, far = wall(6.0, half=1.2), wall(25.0)
    both = depth_image(
        np.concatenate([near, far]).astype(np.float32), T_OPTICAL_BODY, lens, LidarImageConfig()
    )
    behind = np.zeros_like(both, bool)
    # Between the outermost pixels of the near wall everything far is hidden.
    rows, columns = np.nonzero((both > 0) & (both < 10))
    behind[rows.min() : rows.max(), columns.min() : columns.max()] = True
    hidden = behind & (both > 10)
    free = ~behind & (both > 10)
    assert hidden.sum() > 500 and free.sum() > 500
    kept = without_hidden(both, lens, LidarImageConfig(radius=9)) > 0
    assert kept[hidden].mean() < 0.02
    assert kept[free].mean() > 0.8
    assert kept[(both > 0) & (both < 10)].mean() > 0.95


def test_a_strict_threshold_keeps_the_visible_ground():
    lens = make_lens(camera(200, 100, 120.0))
    rng = np.random.default_rng(2)
    points = ground() + rng.normal(0, 0.02, ground().shape)
    depth = depth_image(points.astype(np.float32), T_OPTICAL_BODY, lens, LidarImageConfig())
    kept = without_hidden(depth, lens, LidarImageConfig(threshold=3.9999)) > 0
    assert kept.sum() > 0.98 * (depth > 0).sum()


def test_radius_zero_filters_nothing():
    lens, settings = make_lens(camera()), LidarImageConfig(radius=0)
    depth = depth_image(street(np.random.default_rng(3)), T_OPTICAL_BODY, lens, settings)
    np.testing.assert_array_equal(without_hidden(depth, lens, settings), depth)
