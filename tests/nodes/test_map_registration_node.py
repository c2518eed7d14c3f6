"""Feed map_registration images and predictions; its network is told what to answer."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from bags.nodes.lockstep import LockStep
from cmrnet_ekf import euler
from cmrnet_ekf.camera_localizer import base_covariance
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from cmrnet_ekf.networks.checkpoint import save_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.nodes.camera_messages import (
    camera_from_message,
    image_from_message,
    image_message,
)
from cmrnet_ekf.nodes.ekf_node import EkfNode
from cmrnet_ekf.nodes.map_registration_node import MapRegistrationNode
from cmrnet_ekf.overlay import colours, overlay
from cmrnet_ekf.pose_belief import PoseBelief
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY
from cmrnet_ekf.predictors import Predictor
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_common.nodes import messages

pytestmark = pytest.mark.ros
SMALL = CmrnetConfig(
    head='covariance', width=64, height=32, occlusion_radius=0, pyramid=(4, 6), convolutions=1,
    estimator=(8,), squeezed=2, pooled_rows=2, pooled_columns=4, hidden=8, branch=4,
)  # fmt: skip
START_NS = 1_700_000_000_000_000_000
T_BASE_CAMERA = se3.from_rotation_translation(
    se3.so3_exp([0.0, 0.05, 0.2]) @ se3.inverse(T_OPTICAL_BODY)[:3, :3], [1.0, 0.1, 1.6]
)
CORRECTION = np.array([[0.5, -0.3, 0.1, 0.01, -0.02, 0.05]])
SCALE = np.array([[0.2, 0.1, 0.1, 0.01, 0.01, 0.02]])
FAR = np.array([10_000.0, -5_000.0, 3.0])  # where the map is: nothing may be lost there


@pytest.fixture(scope='module')
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp('registration')
    settings = MapConfig(see_through=False, neighbours=0)
    builder = MapBuilder(TileFolder.create(folder / 'map', settings), settings)
    rng = np.random.default_rng(0)
    street = rng.uniform([-5, -10, -0.1], [50, 10, 0.1], (40000, 3)).astype(np.float32)
    T = se3.from_rotation_translation(np.eye(3), FAR)
    builder.add(PointCloud(street), T, np.eye(4))
    builder.finish()
    save_network(folder / 'told.safetensors', Cmrnet(SMALL), {})
    return folder / 'map', folder / 'told.safetensors'


class Fed:
    """A node in lock-step, and what it published."""

    def __init__(self, node: MapRegistrationNode) -> None:
        self.node, self.lockstep = node, LockStep([node])
        self.poses: list[PoseWithCovarianceStamped] = []
        self.overlays: list[Image] = []
        self.lockstep.listen('/camera_pose', self.poses.append)
        self.lockstep.listen('/camera_pose/overlay', self.overlays.append)

    def mount(self) -> None:
        mounts = [
            TransformStamped(
                header=messages.header(START_NS, 'base_link'),
                child_frame_id=child,
                transform=messages.transform_message(T),
            )
            for child, T in (('camera', T_BASE_CAMERA), ('imu', np.eye(4)))
        ]
        self.lockstep.feed('/tf_static', TFMessage(transforms=mounts))

    def info(self, step: int, **changes: Any) -> None:
        info = CameraInfo(header=messages.header(START_NS + step * 10**8, 'camera'))
        info.width, info.height, info.distortion_model = 64, 32, 'plumb_bob'
        info.k = [40.0, 0.0, 31.0, 0.0, 40.0, 15.0, 0.0, 0.0, 1.0]
        for name, value in changes.items():
            setattr(info, name, value)
        self.lockstep.feed('/camera/camera_info', info)

    def image(self, step: int, value: int = 90) -> None:
        pixels = np.full((32, 64, 3), value, np.uint8)
        image = image_message(pixels, START_NS + step * 10**8, 'camera')
        self.lockstep.feed('/camera/image', image)

    def predict(self, step: float, T: np.ndarray, deviation: float = 0.3) -> None:
        odometry = Odometry(header=messages.header(START_NS + round(step * 10**8), 'map'))
        odometry.pose = messages.pose_with_covariance(T, np.eye(6) * deviation**2)
        self.lockstep.feed('/odometry/filtered', odometry)

    def stand(self, first: int, last: int) -> None:
        """Feed ten samples of an IMU that stands, and an image, for each step."""
        for sample in range(10 * first + 1, 10 * last + 1):
            imu = Imu(header=messages.header(START_NS + sample * 10**7, 'imu'))
            imu.linear_acceleration = Vector3(z=9.81)
            self.lockstep.feed('/imu', imu)
            if sample % 10 == 0:
                self.image(sample // 10)

    def counted(self, cause: str) -> int:
        return self.node.diagnostics.counted(cause)

    def warning(self) -> str:
        status = self.node.diagnostics.status()
        assert (status.level == DiagnosticStatus.OK) == (status.message == 'ok')
        return str(status.message)


@pytest.fixture
def told(
    make: Callable[..., Any], files: tuple[Path, Path], monkeypatch: Any
) -> Callable[..., Fed]:
    def belief(self: Predictor, image: Any, lidar: Any) -> PoseBelief:
        normal = np.full((1, 6), np.inf)
        return PoseBelief(CORRECTION, SCALE, normal, SCALE**2)

    monkeypatch.setattr(Predictor, 'belief', belief)

    def construct(**parameters: object) -> Fed:
        given = {'map': str(files[0]), 'weights': str(files[1]), 'threaded': False}
        return Fed(make(MapRegistrationNode, **(given | parameters)))

    return construct


def at(x: float) -> np.ndarray:
    return se3.from_rotation_translation(se3.so3_exp([0, 0, 0.1]), FAR + np.array([x, 0.5, 0.0]))


@pytest.mark.parametrize(
    ('deviation', 'changes', 'asked'),
    [(0.3, {}, [2.0, 1.0]), (0.01, {}, [1.0]), (0.01, {'skip_stages': False}, [2.0, 1.0])],
)
def test_a_sure_prediction_goes_to_the_last_network_alone(
    told: Callable[..., Fed], files: tuple[Path, Path], monkeypatch: Any,
    deviation: float, changes: dict[str, object], asked: list[float],
) -> None:  # fmt: skip
    paths = [files[1].with_name(f'stage_{metres:.0f}.safetensors') for metres in (2.0, 1.0)]
    for path, metres, degrees in zip(paths, (2.0, 1.0), (10.0, 2.0), strict=True):
        save_network(path, Cmrnet(SMALL), {'guesses_m_deg': [[metres, degrees]]})
    fed = told(weights=','.join(map(str, paths)), **changes)
    answer, seen = Predictor.belief, []

    def counted(self: Predictor, image: Any, lidar: Any) -> PoseBelief:
        seen.append(self.trained_for.translation_m)
        return answer(self, image, lidar)

    monkeypatch.setattr(Predictor, 'belief', counted)
    fed.mount()
    fed.info(0)
    fed.image(1)
    T = se3.from_rotation_translation(np.eye(3), FAR)
    for step in (0.5, 1.5):
        fed.predict(step, T, deviation)
    assert len(fed.poses) == 1 and seen == asked


def test_an_image_becomes_a_pose_of_the_vehicle_with_covariance(told: Callable[..., Fed]) -> None:
    fed = told()
    fed.mount()
    fed.info(0)
    fed.predict(0.5, at(4.0))
    fed.image(1)
    assert not fed.poses, 'it waits for a prediction at its stamp or later'
    fed.predict(1.5, at(6.0))
    assert len(fed.poses) == 1
    T_map_guess = at(5.0)  # half way between the predictions
    T_base_body = T_BASE_CAMERA @ T_OPTICAL_BODY
    T_expected = (
        T_map_guess @ T_base_body @ euler.transforms(CORRECTION)[0] @ se3.inverse(T_base_body)
    )
    message = fed.poses[0]
    assert message.header.frame_id == 'map'
    assert messages.stamp_ns(message.header.stamp) == START_NS + 10**8
    T, covariance = messages.from_pose_with_covariance(message.pose)
    np.testing.assert_allclose(T, T_expected, atol=1e-6)
    normal = np.full((1, 6), np.inf)
    belief = PoseBelief(CORRECTION, SCALE, normal, SCALE**2)
    expected = base_covariance(belief, se3.inverse(T_base_body))
    np.testing.assert_allclose(covariance, expected, atol=1e-9)


def test_the_overlay_shows_the_map_over_the_image(told: Callable[..., Fed]) -> None:
    fed = told(overlay='always')
    fed.mount()
    fed.info(0)
    fed.image(1)
    fed.predict(0.9, at(5.0))
    fed.predict(1.1, at(5.0))
    shown = image_from_message(fed.overlays[0])
    assert shown.shape == (32, 64, 3)
    dark = (shown == int(90 * 0.7)).all(2)
    assert dark[:8].all(), 'there is no map in the sky'
    assert (~dark[20:]).mean() > 0.2


def test_what_cannot_be_used_is_counted(told: Callable[..., Fed]) -> None:
    fed = told(max_trace_translation=1.0)
    fed.info(0)
    assert fed.counted('rejected camera_info: no transform') == 1
    fed.image(1)
    assert fed.counted('rejected images: no calibration') == 1
    fed.mount()
    fed.info(1, distortion_model='equidistant')
    assert fed.counted('rejected camera_info: unusable') == 1
    fed.info(2)
    fed.predict(2.5, at(5.0), deviation=4.0)
    fed.image(3)
    fed.predict(3.5, at(5.0), deviation=4.0)
    assert fed.counted('rejected images: prediction too uncertain') == 1
    fed.image(4)
    fed.predict(4.5, se3.inverse(at(5.0)))
    fed.image(5)
    fed.predict(5.5, se3.inverse(at(5.0)))
    assert fed.counted('rejected images: no map in sight') >= 1
    assert not fed.poses


def test_diagnostics_warn_while_images_come_in_vain(told: Callable[..., Fed]) -> None:
    fed = told()
    fed.mount()
    fed.image(1)
    assert 'images come, but no usable camera_info' in fed.warning()
    fed.info(1)
    assert fed.warning() == 'ok'
    for step in (2, 3, 4):
        fed.image(step)
    assert fed.warning() == 'ok', 'they may wait'
    fed.image(5)
    assert 'initialpose' in fed.warning() and 'no prediction' in fed.warning()
    fed.predict(5.0, at(5.0), deviation=4.0)
    assert 'off by 4.0 m, too uncertain' in fed.warning() and 'no pred' not in fed.warning()
    fed.predict(6.0, at(5.0))
    fed.image(6)
    assert fed.warning() == 'ok' and len(fed.poses) == 1
    fed.image(7)
    fed.predict(9.0, at(5.0))
    assert 'max_prediction_gap' in fed.warning()
    fed.image(8)
    fed.predict(9.5, at(5.0))
    assert 'max_prediction_gap' in fed.warning()
    fed.image(10)
    fed.predict(10.0, at(5.0))
    assert fed.warning() == 'ok' and len(fed.poses) == 2


def test_beside_ekf_images_are_refined_once_somebody_says_where_it_is(
    told: Callable[..., Fed], make: Callable[..., Any], monkeypatch: Any
) -> None:
    fed = told()
    ekf = make(
        EkfNode, odometry='', fixes='', start_from='set_pose', frozen_imu=0, publish_rate=0.0
    )
    fed.lockstep.add(ekf)
    predicted: list[np.ndarray] = []
    fed.lockstep.listen(
        '/odometry/filtered',
        lambda message: predicted.append(messages.transform_from_pose(message.pose.pose)),
    )
    T_base_body = T_BASE_CAMERA @ T_OPTICAL_BODY

    def knows(self: Predictor, image: Any, lidar: Any) -> PoseBelief:
        T_guess_true = se3.inverse(predicted[-1] @ T_base_body) @ at(5.0) @ T_base_body
        return PoseBelief(
            euler.components(T_guess_true)[None], SCALE, np.full((1, 6), np.inf), SCALE**2
        )

    monkeypatch.setattr(Predictor, 'belief', knows)
    fed.mount()
    fed.info(0)
    fed.stand(0, 5)
    assert not fed.poses and not predicted
    assert 'start ekf by initialpose' in fed.warning()
    start = PoseWithCovarianceStamped(header=messages.header(START_NS + 5 * 10**8, 'map'))
    start.pose = messages.pose_with_covariance(at(5.8), None)
    fed.lockstep.feed('/initialpose', start)
    fed.stand(5, 20)
    assert fed.warning() == 'ok'
    assert len(fed.poses) >= 15
    assert ekf.diagnostics.counted('camera accepted') == len(fed.poses)
    assert se3.distance(predicted[-1], at(5.0))[0] < 0.2
    # What ekf forgets, somebody has to say again.
    ekf.on_reset(Trigger.Request(), Trigger.Response())
    fed.poses.clear()
    fed.stand(20, 25)
    assert not fed.poses and 'start ekf by initialpose' in fed.warning()


def test_estimates_that_are_too_uncertain_are_rejected(told: Callable[..., Fed]) -> None:
    fed = told(max_trace_rotation=1e-4)
    fed.mount()
    fed.info(0)
    fed.image(1)
    fed.predict(0.9, at(5.0))
    fed.predict(1.1, at(5.0))
    assert fed.counted('rejected images: uncertain estimate') == 1
    assert not fed.poses


def test_images_of_the_wrong_size_do_not_stop_it(told: Callable[..., Fed]) -> None:
    fed = told()
    fed.mount()
    fed.info(0, width=80)
    fed.image(1)
    fed.predict(0.9, at(5.0))
    fed.predict(1.1, at(5.0))
    assert fed.counted('rejected images: unusable') == 1
    fed.info(2)
    fed.image(2)
    fed.predict(2.1, at(5.0))
    assert len(fed.poses) == 1


def test_it_starts_with_a_map_and_a_network_that_knows(
    make: Callable[..., Any], files: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match='build_lidar_map'):
        make(MapRegistrationNode)
    plain = tmp_path / 'plain.safetensors'
    from dataclasses import replace

    save_network(plain, Cmrnet(replace(SMALL, head='quaternion')), {})
    with pytest.raises(ConfigError, match='how sure'):
        make(MapRegistrationNode, map=str(files[0]), weights=str(plain))


def test_images_in_every_encoding() -> None:
    rgb = np.random.default_rng(1).integers(0, 256, (3, 5, 3), np.uint8)
    message = image_message(rgb, 1, 'camera')
    np.testing.assert_array_equal(image_from_message(message), rgb)
    message.encoding = 'bgr8'
    np.testing.assert_array_equal(image_from_message(message), rgb[:, :, ::-1])
    padded = np.zeros((3, 20), np.uint8)
    padded[:, :15] = rgb.reshape(3, 15)
    wide = Image(height=3, width=5, encoding='rgb8', step=20, data=padded.tobytes())
    np.testing.assert_array_equal(image_from_message(wide), rgb)
    grey = Image(height=3, width=5, encoding='mono8', step=5, data=rgb[..., 0].tobytes())
    np.testing.assert_array_equal(image_from_message(grey), rgb[..., 0])
    for broken in ({'encoding': '16UC1'}, {'height': 4}, {'step': 3}):
        message = image_message(rgb, 1, 'camera')
        for name, value in broken.items():
            setattr(message, name, value)
        with pytest.raises(DataError, match='image'):
            image_from_message(message)


def test_calibrations_of_parts_of_an_image_are_refused() -> None:
    info = CameraInfo(width=64, height=32, distortion_model='plumb_bob', d=[0.1, 0, 0, 0, 0])
    assert camera_from_message(info).distortion == (0.1, 0, 0, 0, 0)
    info.roi.width = 10
    with pytest.raises(DataError, match='roi'):
        camera_from_message(info)


def test_near_points_are_red_and_far_ones_blue() -> None:
    near, far = colours(np.array([2.0, 90.0], np.float32)).astype(int)
    assert near[0] > near[2] and far[2] > far[0]
    depth = np.zeros((2, 2), np.float32)
    depth[0, 0] = 2.0
    image = overlay(np.full((2, 2, 3), 100, np.uint8), depth)
    assert (image[0, 0] == near).all() and (image[1, 1] == 70).all()
