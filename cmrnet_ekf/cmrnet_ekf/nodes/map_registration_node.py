"""Refine where the vehicle is by a camera image and a LiDAR map, and say how surely.

    ros2 run cmrnet_ekf map_registration --ros-args --params-file config/map_registration.yaml
    ros2 run cmrnet_ekf map_registration --ros-args -p map:=town

Subscribes  camera/image (sensor_msgs/Image), camera/camera_info (sensor_msgs/CameraInfo),
            odometry/filtered (nav_msgs/Odometry: the predicted pose in the map, from ekf),
            /tf_static (where the camera sits)
Publishes   camera_pose (geometry_msgs/PoseWithCovarianceStamped of base_link in the map),
            camera_pose/overlay (sensor_msgs/Image: the map over the image, from the refined pose),
            /diagnostics

An image waits for the prediction at its stamp. While one is worked on, only the newest waits.
Predictions that are too uncertain (max_deviation), that look where there is no map, or that the
network's uncertainty marks as failures (max_trace) are counted and not published. While images
come that cannot be refined at all (no calibration, no prediction, a prediction that is too
uncertain), the diagnostics warn and say what is missing: ekf has a prediction only once somebody
told it where the vehicle is (initialpose or ~/set_pose).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from cmrnet_ekf.camera_localizer import CameraLocalizer, PoseEstimate
from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig, near_origin
from cmrnet_ekf.nodes.camera_messages import (
    camera_from_message,
    image_from_message,
    image_message,
)
from cmrnet_ekf.overlay import overlay
from cmrnet_ekf.predictors import SHIPPED, Predictor
from cmrnet_ekf.rejection import traces
from lcd_common import se3
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.nodes.worker import Worker
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import StampBuffer, StampedPose, Unpaired
from lcd_loop_closure.nodes.odometry_message import odometry_pose
from lcd_loop_closure.nodes.stream_watch import StreamWatch

_NO_PREDICTION = {
    Unpaired.BUFFER_FULL: 'odometry/filtered is silent; start ekf by initialpose or ~/set_pose',
    Unpaired.TOO_OLD: 'they are older than odometry/filtered, or it came too late',
    Unpaired.GAP: 'odometry/filtered has gaps longer than max_prediction_gap',
}


@config
class MapRegistrationConfig:
    """How the node runs."""

    map: str = setting('', 'folder of the LiDAR map (build_lidar_map)')
    weights: str = setting(
        '',
        'networks that refine one after the other, separated by commas: .safetensors files of '
        'train_cmrnet, or folders of them as ensembles; empty: those that ship (DER, trained on '
        'simulated towns only)',
    )
    skip_stages: bool = setting(
        True,
        'begin with the last network that was trained for guesses as wrong as the prediction may '
        'be (two deviations); false: ask all, one after the other',
    )
    samples: int = setting(30, 'draws of MC dropout', low=2)
    base_frame: str = setting('base_link', 'frame of the vehicle')
    max_prediction_gap: float = setting(
        0.2, 'longest time between two predictions to interpolate over', unit='s', low=0.0
    )
    waiting_images: int = setting(3, 'images that may wait for their prediction', low=1)
    max_deviation: float = setting(
        3.0, 'predictions with a larger deviation of position are not refined; 0: all are',
        unit='m', low=0.0,
    )  # fmt: skip
    least_fill: float = setting(0.02, 'share of pixels that must show the map', low=0.0, high=1.0)
    max_trace_translation: float = setting(
        0.0, 'estimates with a larger trace of the covariance are rejected; 0: none', unit='m^2',
        low=0.0,
    )  # fmt: skip
    max_trace_rotation: float = setting(0.0, 'the same of rotation', unit='rad^2', low=0.0)
    overlay: str = setting(
        'subscribed',
        'publish the overlay: while somebody looks at it, always, or never',
        choices=('subscribed', 'always', 'never'),
    )
    device: str = setting('auto', 'where the networks run: auto, cpu, cuda, cuda:1 ...')
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')


@dataclass(frozen=True)
class _Job:
    """An image with the pose that is predicted for it."""

    image: Image
    predicted: StampedPose
    localizer: CameraLocalizer
    map_frame: str
    covariance: se3.Array | None


class MapRegistrationNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('map_registration', **node_options)
        self.config = declare_config(self, MapRegistrationConfig)
        local_map = declare_config(self, LocalMapConfig, 'local_map')
        c = self.config
        shipped = ','.join(map(str, SHIPPED))
        weights = [path.strip() for path in (c.weights or shipped).split(',')]
        if not c.map:
            raise ConfigError(
                'map_registration needs the parameter map, a folder: build_lidar_map makes one'
            )
        if not all(weights):
            raise ConfigError(f'weights: expected files between the commas, got {c.weights!r}')
        self._map = LocalMap(Path(c.map), local_map)
        device = choose_device(c.device)
        self._stages = [Predictor.load(Path(path), device, c.samples) for path in weights]
        self.get_logger().info(f'{len(weights)} stages run on {device}')
        if self._stages[-1].kind == 'plain':
            raise ConfigError(
                f'{weights[-1]} does not say how sure it is; the last network must be of the '
                'variant mcd, der or covariance, or a folder of an ensemble'
            )
        self.diagnostics = Diagnostics(self)
        self._transforms = StaticTransforms(self)
        self._localizer: CameraLocalizer | None = None
        self._calibrated_by: CameraInfo | None = None
        self._map_frame = 'map'
        self._covariance: se3.Array | None = None
        self._buffer: StampBuffer[Image] = StampBuffer(
            c.waiting_images, round(c.max_prediction_gap * 1e9)
        )
        rewind = self._buffer.rewind
        self._watch_images = StreamWatch(self, self.diagnostics, 'images', 'restart', rewind)
        self._watch_poses = StreamWatch(self, self.diagnostics, 'predictions', 'restart', rewind)
        self._jobs = Worker(
            self._locate,
            capacity=1,
            threaded=c.threaded,
            on_drop=lambda job: self.diagnostics.count('dropped images: machine too slow'),
            on_error=lambda error: self._reject('images', 'failed', repr(error)),
            name=f'{self.get_name()} images',
        )
        self._pose_out = self.create_publisher(
            PoseWithCovarianceStamped, 'camera_pose', qos.RELIABLE
        )
        self._overlay_out = self.create_publisher(Image, 'camera_pose/overlay', qos.RELIABLE)
        self.create_subscription(Image, 'camera/image', self.on_image, qos.SENSOR)
        self.create_subscription(CameraInfo, 'camera/camera_info', self.on_camera_info, qos.SENSOR)
        self.create_subscription(
            Odometry, 'odometry/filtered', self.on_odometry_filtered, qos.RELIABLE
        )

    def on_camera_info(self, message: CameraInfo) -> None:
        """Prepare for the camera, once and whenever its calibration changes."""
        if self._localizer is not None and _same(self._calibrated_by, message):
            return
        frame = message.header.frame_id
        T_base_camera = self._transforms.lookup(self.config.base_frame, frame)
        problem = None
        if T_base_camera is None:
            problem = f'/tf_static does not connect {self.config.base_frame} with {frame}: no poses'
            self._reject('camera_info', 'no transform', problem)
        else:
            try:
                camera = camera_from_message(message)
                self._localizer = CameraLocalizer(camera, T_base_camera, self._stages)
                self._calibrated_by = message
                self.diagnostics.warn('calibration', None)
            except DataError as error:
                problem = str(error)
                self._reject('camera_info', 'unusable', problem)
        self.diagnostics.error('camera', problem)

    def on_image(self, message: Image) -> None:
        """Let an image wait for the prediction at its stamp."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if not self._watch_images.takes(stamp_ns):
            return
        self.diagnostics.tick('images', stamp_ns)
        if self._localizer is None:
            text = 'images come, but no usable camera_info: no poses'
            self._reject('images', 'no calibration', text)
            self.diagnostics.warn('calibration', text)
            return
        self._pair(self._buffer.add_item(stamp_ns, message))

    def on_odometry_filtered(self, message: Odometry) -> None:
        """Give the waiting images their predictions."""
        try:
            pose = odometry_pose(message)
        except DataError as error:
            self._reject('predictions', 'broken', str(error))
            return
        if self._watch_poses.takes(pose.stamp_ns):
            self._map_frame = message.header.frame_id
            # A filter corrects between two poses: what is in between has no covariance of its own.
            if pose.covariance is not None:
                self._covariance = pose.covariance
            self._pair(self._buffer.add_pose(pose))

    def destroy_node(self) -> None:
        """Stop the worker, then the node."""
        self._jobs.stop()
        super().destroy_node()

    def _pair(self, paired: list[Any]) -> None:
        for _, why in self._buffer.unpaired:
            self.diagnostics.count(f'rejected images: no prediction ({why.value})')
            text = f'images come, but no prediction for them: {_NO_PREDICTION[why]}'
            self.diagnostics.warn('prediction', text)
            self.get_logger().warning(text, throttle_duration_sec=5.0)
        self._buffer.unpaired.clear()
        if paired:
            self.diagnostics.warn('prediction', None)
        for pair in paired:
            assert self._localizer is not None
            self._jobs.put(
                _Job(pair.item, pair.pose, self._localizer, self._map_frame, self._covariance)
            )

    def _locate(self, job: _Job) -> None:
        limit, deviation_m, first = self.config.max_deviation, 0.0, 0
        if job.covariance is not None:
            deviation_m = float(np.sqrt(np.linalg.eigvalsh(job.covariance[:3, :3])[-1]))
            if self.config.skip_stages:
                first = job.localizer.first_stage(job.covariance)
        if 0 < limit < deviation_m:
            text = (
                f'the prediction may be off by {deviation_m:.1f} m, too uncertain to refine '
                f'(max_deviation {limit:g} m): tell ekf where the vehicle is (initialpose)'
            )
            self._reject('images', 'prediction too uncertain', text)
            self.diagnostics.warn('uncertain', text)
            return
        self.diagnostics.warn('uncertain', None)
        with self.diagnostics.stage('image'):
            try:
                pixels = image_from_message(job.image)
                points, origin = self._map.around(job.predicted.T_odom_base)
                T_near_guess = near_origin(job.predicted.T_odom_base, origin)
                estimate = job.localizer.locate(pixels, points, T_near_guess, first)
            except DataError as error:
                self._reject('images', 'unusable', str(error))
                return
        problem = self._problem(estimate)
        if problem is None:
            self._publish(job, estimate, origin)
        else:
            self.diagnostics.count(f'rejected images: {problem}')
        self.diagnostics.warn('registration', problem)
        if self._shows():
            self._show(job, pixels, points, estimate)

    def _shows(self) -> bool:
        if self.config.overlay == 'subscribed':
            return self._overlay_out.get_subscription_count() > 0
        return self.config.overlay == 'always'

    def _problem(self, estimate: PoseEstimate) -> str | None:
        c = self.config
        if estimate.fill < c.least_fill:
            return 'no map in sight'
        if not se3.is_covariance(estimate.covariance):
            return 'no usable covariance'
        translation, rotation = traces(estimate.belief)[0]
        if (0 < c.max_trace_translation < translation) or (0 < c.max_trace_rotation < rotation):
            return 'uncertain estimate'
        return None

    def _publish(self, job: _Job, estimate: PoseEstimate, origin: se3.Array) -> None:
        T_map_base = estimate.T_map_base.copy()
        T_map_base[:3, 3] += origin
        stamp_ns = job.predicted.stamp_ns
        message = PoseWithCovarianceStamped(header=messages.header(stamp_ns, job.map_frame))
        message.pose = messages.pose_with_covariance(T_map_base, estimate.covariance)
        self._pose_out.publish(message)
        self.diagnostics.tick('camera_pose', stamp_ns)

    def _show(self, job: _Job, pixels: Any, points: Any, estimate: PoseEstimate) -> None:
        framed = job.localizer.framing.image(pixels)
        depth = job.localizer.view(points, estimate.T_map_base).cpu().numpy()
        frame = job.image.header.frame_id
        out = image_message(overlay(framed, depth), job.predicted.stamp_ns, frame)
        self._overlay_out.publish(out)

    def _reject(self, what: str, cause: str, text: str) -> None:
        self.diagnostics.count(f'rejected {what}: {cause}')
        self.get_logger().warning(text, throttle_duration_sec=5.0)


def _same(one: CameraInfo | None, other: CameraInfo) -> bool:
    """Tell whether two calibrations agree in all but their stamps."""
    return one is not None and (
        one.header.frame_id == other.header.frame_id
        and (one.width, one.height) == (other.width, other.height)
        and list(one.k) == list(other.k)
        and list(one.d) == list(other.d)
    )


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""
    return run_node(MapRegistrationNode, __doc__ or '', argv)
