"""LiDAR-Iris against its formulas, written out, and on a simulated street."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure.baselines.lidar_iris import LidarIris, LidarIrisConfig, responses

SMALL = LidarIrisConfig(rings=10, sectors=72, peaks=0, scales=3, wavelength=6.0, frequencies=20)


def images(rng, count):
    """Codes with empty rows and rows of one value, which have no response."""
    made = rng.integers(0, 256, (count, 10, 72)) * (rng.random((count, 10, 72)) < 0.6)
    for image in made:
        image[rng.integers(0, 10, 2)] = 0
        image[rng.integers(0, 10)] = 7
    return made.astype(np.float32)


def features(image, s):
    """Signs of the responses and which of them count, one filter and one row at a time."""
    signs, counts = [], []
    for part in (np.real, np.imag):
        for scale in range(s.scales):
            for row in image.astype(float):
                spectrum = np.zeros(s.sectors, complex)
                for k in range(1, s.sectors // 2 + 1):
                    wave = np.exp(-2j * np.pi * k * np.arange(s.sectors) / s.sectors)
                    ratio = k / s.sectors * s.wavelength * s.growth**scale
                    gain = np.exp(-(np.log(ratio) ** 2) / (2 * np.log(s.bandwidth) ** 2))
                    spectrum[k] = gain * (row @ wave)
                response = np.fft.ifft(spectrum)
                signs.append(part(response) > 0)
                counts.append(np.ptp(row) > 0)
    return np.array(signs), np.array(counts)


def by_the_paper(query, match, s):
    (a, kept_a), (b, kept_b) = features(query, s), features(match, s)
    kept = kept_a & kept_b
    share = [np.mean((np.roll(a, k, axis=1) != b)[kept]) for k in range(s.sectors)]
    return min(share), int(np.argmin(share))


def test_a_wave_is_answered_by_itself_and_its_quadrature():
    s, x = LidarIrisConfig(), np.arange(360)
    wave = 2 * np.pi * 20 * x / 360 + 0.3
    answer = responses(np.cos(wave)[None] + 5.0, s)
    for scale in range(4):
        gain = np.exp(-(np.log(20 / 360 * 18 * 1.6**scale) ** 2) / (2 * np.log(0.75) ** 2))
        np.testing.assert_allclose(answer[scale, 0], 0.5 * gain * np.exp(1j * wave), atol=1e-9)


def test_distances_and_yaws_are_those_of_the_formula():
    query, *matches = images(np.random.default_rng(0), 8)
    iris = LidarIris(SMALL)
    rows = np.array([iris.row(image.ravel()) for image in matches])
    assert rows.shape == (7, iris.row_length)
    distance, yaw = iris.compare(iris.row(query.ravel()), rows)
    for image, got, heading in zip(matches, distance, yaw, strict=True):
        expected, turn = by_the_paper(query, image, SMALL)
        assert got == pytest.approx(expected, abs=1e-6)
        assert np.cos(heading - 2 * np.pi * turn / 72) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize('turned', [0, 1, 90, 180, 359])
def test_a_turn_by_whole_sectors_is_found_exactly(turned):
    rng = np.random.default_rng(1)
    sector, distance = rng.integers(0, 360, 4000), rng.uniform(3.0, 79.0, 4000)
    azimuth, height = 2 * np.pi * (sector + 0.5) / 360, rng.uniform(-1.0, 6.0, 4000)
    yaw = np.radians(turned)
    iris = LidarIris()
    match, query = (
        iris.row(iris.describe(PointCloud(np.stack(
            [distance * np.cos(a), distance * np.sin(a), height], axis=1).astype(np.float32))))
        for a in (azimuth, azimuth - yaw)
    )  # fmt: skip
    found_distance, found = iris.compare(query, match[None])
    assert found_distance[0] == pytest.approx(0.0, abs=1e-6)
    assert np.cos(found[0] - yaw) == pytest.approx(1.0, abs=1e-6)


def test_a_pixel_has_a_bit_for_each_slice_of_height():
    iris = LidarIris(LidarIrisConfig(lowest=0.0, slice_height=2.0))
    heights = [-9.0, 0.5, 3.0, 99.0, 99.0]  # the first slice ends at 0, the last begins at 12
    xyz = np.array([[5.5, 0.01, z] for z in heights] + [[81.0, 0.0, 1.0]], np.float32)
    image = iris.describe(PointCloud(xyz)).reshape(80, 360)
    assert image[5, 0] == 0b10000111
    assert np.count_nonzero(image) == 1


def test_the_correlation_finds_the_best_of_all_turns(street_views):
    few, every = LidarIris(), LidarIris(LidarIrisConfig(peaks=0))
    for match, query in street_views:
        image = [few.describe(view.cloud) for view in (query, match)]
        a, b = few.row(image[0]), few.row(image[1])
        distance, yaw = few.compare(a, b[None])
        best, best_yaw = every.compare(a, b[None])
        assert distance[0] == pytest.approx(best[0], abs=1e-6)
        assert yaw[0] == best_yaw[0]
        true = se3.yaw(se3.inverse(match.T_world_base) @ query.T_world_base)
        assert np.cos(yaw[0] - true) > np.cos(np.radians(5.0))


def test_nothing_in_common_is_as_far_as_it_gets():
    iris = LidarIris()
    empty = iris.row(iris.describe(PointCloud(np.empty((0, 3), np.float32))))
    assert iris.compare(empty, empty[None])[0][0] == 1.0


def test_what_does_not_fit_is_refused():
    with pytest.raises(DataError, match='28800 numbers, got 60'):
        LidarIris().row(np.zeros(60, np.float32))
    with pytest.raises(ConfigError, match='turn_filter must be below scales = 2, got 3'):
        LidarIris(LidarIrisConfig(scales=2, turn_filter=3))
