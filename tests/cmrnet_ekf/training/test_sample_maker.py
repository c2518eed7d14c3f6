import numpy as np
import pytest
from small_samples import CAMERA, SMALL, T_BASE_CAMERA, StreetWithCamera, street_map, street_samples

from cmrnet_ekf.camera_localizer import framing_of, imager_of
from cmrnet_ekf.mapping.local_map import near_origin
from cmrnet_ekf.pose_sampling import STAGES, T_OPTICAL_BODY
from cmrnet_ekf.training.sample_maker import SamplesConfig, make_samples
from cmrnet_ekf.training.sample_set import SampleSet
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.trajectory import Trajectory


def test_a_sample_is_the_map_from_the_guess_and_the_image_from_the_truth(tmp_path):
    samples = street_samples(tmp_path)
    drive, local_map = StreetWithCamera(), street_map(tmp_path / 'again')
    assert len(samples) == 5 * 3, 'every second image, 3 m apart'
    framing = framing_of(CAMERA, SMALL)
    imager = imager_of(framing.camera, SMALL)
    for index in (0, 7, 14):
        frame = int(samples.frame_of[index])
        np.testing.assert_array_equal(
            samples.frames[frame], framing.image(drive.image(2 * frame).pixels)
        )
        T_map_base = drive.truth().T_world_body[2 * frame]
        points, origin = local_map.around(T_map_base)
        T_body = near_origin(T_map_base, origin) @ T_BASE_CAMERA @ T_OPTICAL_BODY
        T_guess = T_body @ samples.guesses[index]
        expected = imager.image(points, T_OPTICAL_BODY @ se3.inverse(T_guess)).numpy()
        found = samples.batch(np.array([index])).lidar[0].numpy()
        np.testing.assert_allclose(found, expected, atol=0.001)
        assert (found > 0).mean() > 0.02


def test_what_cannot_be_made_is_refused(tmp_path):
    samples = street_samples(tmp_path)
    drive, local_map = StreetWithCamera(), street_map(tmp_path / 'again')

    def make(out, **changes):
        given = {'drive': drive, 'poses': drive.truth(), **changes}
        make_samples(out, given['drive'], given['poses'], local_map, SMALL, STAGES[0],
                     SamplesConfig())  # fmt: skip

    with pytest.raises(ConfigError, match='already'):
        make(samples.path)
    blind = StreetWithCamera()
    blind.camera = None
    with pytest.raises(DataError, match='no camera'):
        make(tmp_path / 'blind', drive=blind)
    elsewhere = drive.truth().in_frame(
        se3.from_rotation_translation(np.eye(3), [0, 5000.0, 0]), np.eye(4)
    )
    with pytest.raises(DataError, match='agree'):
        make(tmp_path / 'elsewhere', poses=elsewhere)


@pytest.mark.parametrize(('turn', 'frames'), [(0.0, 1), (5.0, 5)])
def test_a_bend_is_seen_more_often_than_its_way(tmp_path, turn, frames):
    drive, local_map = StreetWithCamera(), street_map(tmp_path / 'map')
    T = np.tile(np.eye(4), (10, 1, 1))
    for k in range(10):  # three degrees an image, to both sides of straight ahead
        T[k] = se3.rotation_z(np.deg2rad(3.0 * k - 13.5))
        T[k, 0, 3] = 0.1 * k
    settings = SamplesConfig(spacing=100.0, turn=turn, draws=1)
    poses = Trajectory(drive.stamps_ns, T)
    make_samples(tmp_path / 'out', drive, poses, local_map, SMALL, STAGES[0], settings)
    assert SampleSet(tmp_path / 'out').facts['frames'] == frames
