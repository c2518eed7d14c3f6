"""Recognise known places, say how far that can be believed, and find a kidnapped vehicle.

    ros2 run uncertain_place_recognition place_recognition --ros-args \
        --params-file config/place_recognition.yaml

Subscribes  points (sensor_msgs/PointCloud2), odom (nav_msgs/Odometry, any source), /tf_static; with
            follow: keyframes also keyframe (lcd_msgs/Keyframe, from loop_closure) and
            graph/keyframes (sensor_msgs/PointCloud2: id x y z, from pose_graph)
Publishes   place_matches (lcd_msgs/PlaceMatchArray: an answer for each chosen scan, empty while the
            map is), initialpose (geometry_msgs/PoseWithCovarianceStamped: where the vehicle is in
            the loaded map, with relocalize), place_markers (visualization_msgs/MarkerArray),
            /diagnostics
Services    ~/add_place (std_srvs/Trigger): remember where the vehicle is, whatever the spacing
            ~/save_map (lcd_msgs/SaveMap), ~/load_map (lcd_msgs/LoadMap): the places
            ~/relocalize (std_srvs/Trigger): look for the vehicle in the map once more
            ~/reset (std_srvs/Trigger): forget all places

Scans are chosen by odometry (follow: odom), or are those of loop_closure's keyframes (follow:
keyframes): places then have the keyframes' numbers, and move when the pose graph corrects them.
Work is done beside the callbacks; when it cannot keep up, the oldest waiting scan is left out.
Parameters: see config/place_recognition.yaml or `ros2 param describe`.
"""

from dataclasses import dataclass
from typing import Any

import torch
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.nodes.worker import Worker
from lcd_common.priority import lower_priority
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import Paired, StampBuffer, StampedPose
from lcd_loop_closure.keyframes import KeyframeSelector
from lcd_loop_closure.nodes.odometry_message import odometry_pose
from lcd_loop_closure.nodes.positions_message import positions_from_message
from lcd_loop_closure.nodes.stream_watch import StreamWatch
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.reduction import ReductionConfig
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import PlaceMatchArray
from uncertain_place_recognition.drive_places import AskedConfig, DrivePlaces, PlaceSpacingConfig
from uncertain_place_recognition.nodes.answer_watch import AnswerWatch
from uncertain_place_recognition.nodes.declared_recognizer import declared_recognizer
from uncertain_place_recognition.nodes.place_messages import (
    answer_markers,
    initial_pose_message,
    matches_message,
)
from uncertain_place_recognition.nodes.place_services import PlaceServices
from uncertain_place_recognition.place import PlaceAnswer
from uncertain_place_recognition.relocalizer import RelocalizerConfig
from uncertain_place_recognition.scan_keyframes import KeyframeStamp, ScanKeyframes


@config
class PlaceRecognitionNodeConfig:
    """How the node runs; answers, relocalization and spacing are in groups beside these."""

    weights: str = setting('', 'file or folder of an ensemble; empty: the one that ships')
    calibration: str = setting(
        '', 'its calibration; empty: calibration.json beside the weights, if there is one'
    )
    device: str = setting('auto', 'auto (a GPU where there is one), cpu, cuda or cuda:N')
    threads: int = setting(
        1, 'of torch in this process; more fight with other busy processes; 0: all', low=0
    )
    map: str = setting('', 'folder of saved places to start with; empty: none')
    follow: str = setting(
        'odom',
        'which scans are taken: chosen by odometry, or those of loop_closure',
        choices=('odom', 'keyframes'),
    )
    grow: bool = setting(True, 'remember places while driving')
    relocalize: bool = setting(
        False, 'look for the vehicle in the loaded map and publish initialpose'
    )
    map_frame: str = setting('map', 'frame of the places')
    reliable_points: bool = setting(False, 'ask for reliable clouds (replay); else best effort')
    max_odometry_gap: float = setting(
        0.3, 'longest time between two odometry messages to interpolate over', unit='s', low=0.0
    )
    waiting_clouds: int = setting(20, 'clouds that may wait for odometry or keyframe', low=1)
    waiting_scans: int = setting(5, 'chosen scans that may wait for their answer', low=1)
    on_time_jump: str = setting(
        'restart', 'what to do when the clock jumps back', choices=('restart', 'refuse')
    )
    niceness: int = setting(
        10, 'lower priority of the process when it runs alone: odometry goes first', low=0, high=19
    )
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')


@dataclass(frozen=True)
class _Scan:
    """A cloud that is asked about."""

    drive: DrivePlaces
    pose: StampedPose
    points: PointCloud2
    T_base_lidar: se3.Array
    keyframe_id: int | None


class PlaceRecognitionNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('place_recognition', **node_options)
        self.config = declare_config(self, PlaceRecognitionNodeConfig)
        self._selector = KeyframeSelector(declare_config(self, AskedConfig, 'asked'))
        self._spacing = declare_config(self, PlaceSpacingConfig, 'places')
        self._reduction = declare_config(self, ReductionConfig, 'reduction')
        self._relocalizer = declare_config(self, RelocalizerConfig, 'relocalizer')
        if self.config.threads:
            torch.set_num_threads(self.config.threads)
        c = self.config
        self.recognizer = declared_recognizer(
            self, c.weights, c.calibration, self._reduction, c.device, self._spacing.distance
        )
        self.diagnostics = Diagnostics(self)
        self._transforms = StaticTransforms(self)
        self._by_keyframes = self.config.follow == 'keyframes'
        gap_ns = round(self.config.max_odometry_gap * 1e9)
        waiting = self.config.waiting_clouds
        self._buffer: StampBuffer[PointCloud2] = StampBuffer(waiting, gap_ns)
        self._keyframes: ScanKeyframes[PointCloud2] = ScanKeyframes(waiting)
        self._base_frame = 'base_link'
        self.restart(self.config.map)

        jumps = self.config.on_time_jump
        self._watch_odom = StreamWatch(self, self.diagnostics, 'odom', jumps, self._rewind)
        self._watch_points = StreamWatch(
            self, self.diagnostics, 'points', 'restart', self._buffer.rewind
        )
        self._scans: Worker[_Scan] = self._worker(
            'scans', self._recognise, self.config.waiting_scans
        )
        # Only the newest positions matter.
        self._corrections: Worker[GraphPositions] = self._worker('corrections', self._correct, 1)
        self._matches_out = self.create_publisher(PlaceMatchArray, 'place_matches', qos.RELIABLE)
        self._pose_out = self.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.RELIABLE
        )
        self._markers_out = self.create_publisher(MarkerArray, 'place_markers', qos.RELIABLE)
        self.create_subscription(
            PointCloud2, 'points', self.on_points, qos.sensor(self.config.reliable_points)
        )
        self.create_subscription(Odometry, 'odom', self.on_odom, qos.RELIABLE)
        if self._by_keyframes:
            self.create_subscription(KeyframeMessage, 'keyframe', self.on_keyframe, qos.RELIABLE)
            self.create_subscription(
                PointCloud2, 'graph/keyframes', self.on_graph_keyframes, qos.LATCHED
            )
        self.place_services = PlaceServices(self, threaded=self.config.threaded)
        self._answer_watch = AnswerWatch(self.diagnostics, lambda: len(self.recognizer))
        self.diagnostics.watch('scans waiting', self._scans.waiting)

    def on_points(self, message: PointCloud2) -> None:
        """Let a cloud wait for its odometry, or for its keyframe."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if not self._watch_points.takes(stamp_ns):
            return
        self.diagnostics.tick('points', stamp_ns)
        if self._by_keyframes:
            self._take_keyframe(self._keyframes.add_scan(stamp_ns, message))
        else:
            self._choose(self._buffer.add_item(stamp_ns, message))

    def on_odom(self, message: Odometry) -> None:
        """Give the waiting clouds their poses."""
        try:
            pose = odometry_pose(message)
        except DataError as error:
            self._reject('odom', 'broken', str(error))
            return
        if self._watch_odom.takes(pose.stamp_ns):
            self.diagnostics.tick('odom', pose.stamp_ns)
            self._base_frame = message.child_frame_id or 'base_link'
            if not self._by_keyframes:
                self._choose(self._buffer.add_pose(pose))

    def on_keyframe(self, message: KeyframeMessage) -> None:
        """Take the scan that became a keyframe."""
        try:
            T_odom_base = messages.transform_from_pose(message.pose)
        except DataError as error:
            self._reject('keyframe', 'broken', str(error))
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        self.diagnostics.tick('keyframe', stamp_ns)
        self._base_frame = message.child_frame_id or 'base_link'
        keyframe = KeyframeStamp(int(message.id), stamp_ns, T_odom_base)
        if self.drive.starts_again(keyframe.id):
            self.get_logger().warning('loop_closure started a new session: so do the places')
            self.diagnostics.count('sessions restarted')
            self.restart(self.map_path)
        problem = None
        if keyframe.id < self.drive.first_id:
            problem = (
                f'places up to {self.drive.first_id - 1} are loaded, but keyframes are numbered '
                f'from {keyframe.id}: load the map of the same drive in loop_closure, too'
            )
            self._reject('keyframe', 'other session', problem)
        self.diagnostics.error('session', problem)
        if problem is not None:
            return
        lost = self._keyframes.lost
        self._take_keyframe(self._keyframes.add_keyframe(keyframe))
        for _ in range(self._keyframes.lost - lost):
            self._reject('keyframe', 'its cloud did not come', 'a keyframe has no cloud here')

    def on_graph_keyframes(self, message: PointCloud2) -> None:
        """Move the places to where the pose graph has their keyframes."""
        try:
            self._corrections.put(positions_from_message(message))
        except DataError as error:
            self._reject('graph/keyframes', 'broken', str(error))

    def restart(self, path: str) -> None:
        """Begin a drive without places, or with saved ones.

        Raises:
            MapError: they cannot be read; then nothing changes.
        """
        if path:
            count = self.recognizer.load(path)
            self.get_logger().info(f'{path}: {count} places')
        else:
            self.recognizer.clear()
        self.map_path = path
        self._selector.reset()
        self.drive = DrivePlaces(
            self.recognizer,
            self._relocalizer if self.config.relocalize and path else None,
            self._reduction,
            by_keyframes=self._by_keyframes,
            spacing=self._spacing,
        )

    def look_again(self) -> None:
        """Look for the vehicle in the map once more."""
        self.drive.look_again(self._relocalizer)

    def add_next(self) -> None:
        """Let the next scan be a place, whatever the spacing."""
        self._selector.reset()
        self.drive.force_next = True

    def start_over(self) -> None:
        """Forget all places and what waits."""
        self.restart('')
        self._buffer.clear()
        self._keyframes.clear()
        self._watch_odom.reset()
        self._watch_points.reset()

    def destroy_node(self) -> None:
        """Stop the workers, then the node."""
        self._scans.stop()
        self._corrections.stop()
        self.recognizer.close()
        super().destroy_node()

    def _rewind(self, stamp_ns: int) -> None:
        self.restart(self.map_path)
        self._buffer.rewind(stamp_ns)
        self._keyframes.clear()

    def _choose(self, paired: list[Paired[PointCloud2]]) -> None:
        for _, why in self._buffer.unpaired:
            self._reject('points', why.value, f'a cloud was dropped: {why.value}')
        self._buffer.unpaired.clear()
        for pair in paired:
            if self._selector.due(pair.pose.T_odom_base) and self._take(pair.item, pair.pose, None):
                self._selector.take(pair.pose.T_odom_base)

    def _take_keyframe(self, found: tuple[PointCloud2, KeyframeStamp] | None) -> None:
        if found is not None:
            points, keyframe = found
            self._take(points, StampedPose(keyframe.stamp_ns, keyframe.T_odom_base), keyframe.id)

    def _take(self, points: PointCloud2, pose: StampedPose, keyframe_id: int | None) -> bool:
        frame_id = points.header.frame_id
        T_base_lidar = self._transforms.lookup(self._base_frame, frame_id)
        problem = None
        if T_base_lidar is None:
            problem = f'/tf_static does not connect {self._base_frame} with {frame_id}: no answers'
            self._reject('points', 'no transform', problem)
        self.diagnostics.error('transform', problem)
        if T_base_lidar is None:
            return False
        self._scans.put(_Scan(self.drive, pose, points, T_base_lidar, keyframe_id))
        return True

    def _recognise(self, scan: _Scan) -> None:
        drive, stamp_ns = scan.drive, scan.pose.stamp_ns
        if drive is not self.drive:
            return
        cloud = self._cloud(scan)
        if cloud is None:
            return
        try:
            with self.diagnostics.stage('embed'):
                members = self.recognizer.embed(cloud)
        except DataError as error:
            self._reject('points', 'no submap', str(error))
            return
        with self.diagnostics.stage('search'):
            T_map_base = drive.T_map_base(scan.pose.T_odom_base, scan.keyframe_id)
            near = None if T_map_base is None else T_map_base[:3, 3]
            answer = self.recognizer.locate(members, stamp_ns, near)
        self._publish(answer, scan)
        origin = scan.T_base_lidar[:3, 3]
        with self.diagnostics.stage('relocalize'):
            found = drive.relocalize(answer, cloud, scan.pose.T_odom_base, origin)
        if found is not None:
            self.get_logger().info(f'the vehicle is near place {found.place_id} of {self.map_path}')
            self.diagnostics.count('relocalized')
            self._pose_out.publish(initial_pose_message(found, stamp_ns, self.config.map_frame))
        if drive is not self.drive:
            return
        waits = drive.looking and 'looking for the vehicle in the loaded map'
        self.diagnostics.warn('relocalize', waits or None)
        if self.config.grow or drive.force_next:
            added = drive.add(members, cloud, scan.pose, scan.keyframe_id)
            self.diagnostics.count('places added' if added else 'scans that are no places')

    def _cloud(self, scan: _Scan) -> PointCloud | None:
        try:
            cloud = messages.cloud_from_message(scan.points)
        except DataError as error:
            self._reject('points', 'broken', str(error))
            return None
        finite = cloud.finite()
        if len(finite) < len(cloud):
            self.diagnostics.count('points without coordinates', len(cloud) - len(finite))
        return PointCloud(finite.xyz, finite.intensity).transformed(scan.T_base_lidar)

    def _publish(self, answer: PlaceAnswer, scan: _Scan) -> None:
        self.diagnostics.tick('answers', scan.pose.stamp_ns)
        self._answer_watch.take(answer)
        self._matches_out.publish(matches_message(answer, scan.points.header))
        self.diagnostics.warn('guarantee', answer.withdrawn and f'no guarantee: {answer.withdrawn}')
        best = answer.best
        if answer.withdrawn is not None:
            self.diagnostics.count('answers without guarantee')
        elif best is not None:
            self.diagnostics.count('answers accepted' if best.accepted else 'answers rejected')
        T_map_base = scan.drive.T_map_base(scan.pose.T_odom_base, scan.keyframe_id)
        self._markers_out.publish(
            answer_markers(answer, T_map_base, scan.pose.stamp_ns, self.config.map_frame)
        )

    def _correct(self, graph: GraphPositions) -> None:
        with self.diagnostics.stage('corrections'):
            self.recognizer.move(self.drive.corrected(graph))

    def _worker(self, name: str, work: Any, capacity: int) -> Worker[Any]:
        def dropped(item: Any) -> None:
            if capacity > 1:
                self.diagnostics.count(f'dropped {name}: machine too slow')

        return Worker(
            work,
            capacity=capacity,
            threaded=self.config.threaded,
            on_drop=dropped,
            on_error=lambda error: self._reject(name, 'failed', repr(error)),
            name=f'{self.get_name()} {name}',
        )

    def _reject(self, what: str, cause: str, text: str) -> None:
        self.diagnostics.count(f'rejected {what}: {cause}')
        self.get_logger().warning(text, throttle_duration_sec=5.0)


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""

    def make() -> Node:
        node = PlaceRecognitionNode()
        lower_priority(node.config.niceness)
        return node

    return run_node(make, __doc__ or '', argv)
