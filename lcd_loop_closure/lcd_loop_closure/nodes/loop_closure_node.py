"""Find loops in a stream of clouds and odometry.

    ros2 run lcd_loop_closure loop_closure --ros-args --params-file config/loop_closure.yaml

Subscribes  points (sensor_msgs/PointCloud2), odom (nav_msgs/Odometry, any source), /tf_static,
            graph/keyframes (sensor_msgs/PointCloud2: id x y z, from pose_graph; optional),
            place_matches (lcd_msgs/PlaceMatchArray, with gate.use)
Publishes   keyframe (lcd_msgs/Keyframe), loop_constraint (lcd_msgs/LoopConstraint: every candidate,
            accepted or rejected with the reason), /diagnostics
Services    ~/load_map (lcd_msgs/LoadMap): look for loops with a saved map, and number on from it
            ~/reset (std_srvs/Trigger): forget all keyframes

Clouds wait for the odometry at their stamp. Keyframes are published at once; the search for loops
runs beside, and when it cannot keep up, the oldest waiting keyframe is not searched (it stays a
candidate for later ones). In lock-step replay all of it happens inside the callbacks, or with
`beside` in a process of its own. With gate.use a keyframe waits for what place recognition says of
its scan; one that it rejects is not registered with candidates by descriptor. Parameters: see
config/loop_closure.yaml or `ros2 param describe`.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from lcd_common import se3
from lcd_common.errors import ConfigError, DataError, MapError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.nodes.worker import Worker
from lcd_common.priority import lower_priority
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import Paired, StampBuffer, StampedPose
from lcd_loop_closure.keyframes import Keyframe, KeyframeConfig, KeyframeSelector
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.loop_detector import LoopDetectorSettings
from lcd_loop_closure.loop_search import LoopSearch, SearchJob, Session
from lcd_loop_closure.map_store import load_map
from lcd_loop_closure.nodes.conversions import keyframe_message, loop_message
from lcd_loop_closure.nodes.group_parameters import declare_groups
from lcd_loop_closure.nodes.odometry_message import odometry_pose
from lcd_loop_closure.nodes.place_verdict import place_verdict
from lcd_loop_closure.nodes.positions_message import positions_from_message
from lcd_loop_closure.nodes.stream_watch import StreamWatch
from lcd_loop_closure.place_gate import PlaceGate, PlaceGateConfig, PlaceVerdict
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.search_process import Found, SearchProcess, Sweep
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage
from lcd_msgs.msg import PlaceMatchArray
from lcd_msgs.srv import LoadMap

# A vehicle that stands makes no next keyframe: the last one must not wait for it.
_LONGEST_BESIDE_NS = 1_000_000_000


@config
class LoopClosureNodeConfig:
    """How the node runs; the detector's own settings are in groups beside these."""

    map: str = setting('', 'folder of a saved map to find loops with from the start; empty: none')
    reliable_points: bool = setting(False, 'ask for reliable clouds (replay); else best effort')
    max_odometry_gap: float = setting(
        0.3, 'longest time between two odometry messages to interpolate over', unit='s', low=0.0
    )
    waiting_clouds: int = setting(10, 'clouds that may wait for their odometry', low=1)
    waiting_searches: int = setting(20, 'keyframes that may wait for the search of loops', low=1)
    on_time_jump: str = setting(
        'restart', 'what to do when the clock jumps back', choices=('restart', 'refuse')
    )
    niceness: int = setting(
        10, 'lower priority of the process when it runs alone: odometry goes first', low=0, high=19
    )
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')
    beside: bool = setting(
        False,
        'with threaded false: describe and search in a process of its own, and publish what it '
        'found with the next keyframe; not with gate.use',
    )


@dataclass(frozen=True)
class _Scan:
    """A cloud that becomes a keyframe."""

    session: Session
    pose: StampedPose
    points: PointCloud2
    T_base_lidar: se3.Array
    frames: tuple[str, str]


class LoopClosureNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('loop_closure', **node_options)
        self.config = declare_config(self, LoopClosureNodeConfig)
        self._selector = KeyframeSelector(declare_config(self, KeyframeConfig, 'keyframes'))
        detector = declare_groups(self, LoopDetectorSettings())
        self.diagnostics = Diagnostics(self)
        self._transforms = StaticTransforms(self)
        self._search = None if self.config.beside else LoopSearch(detector, self.diagnostics.stage)
        if self._search is not None and self._search.device:
            self.get_logger().info(f'the descriptor runs on {self._search.device}')
        self._buffer: StampBuffer[PointCloud2] = StampBuffer(
            self.config.waiting_clouds, round(self.config.max_odometry_gap * 1e9)
        )
        self._gate: PlaceGate[SearchJob] = PlaceGate(
            declare_config(self, PlaceGateConfig, 'gate'), self._search_gated
        )
        if self.config.beside and (self.config.threaded or self._gate.settings.use):
            raise ConfigError(
                'beside is for lock-step replay without place recognition: it needs threaded false '
                'and gate.use false (an offline drive with one thread does without beside)'
            )
        self._graph: GraphPositions | None = None
        self._remembered = 0
        self._unsearched: deque[SearchJob] = deque()
        self._frames = ('odom', 'base_link')
        self._session = Session()
        self._start(self.config.map)

        jumps = self.config.on_time_jump
        self._watch_odom = StreamWatch(self, self.diagnostics, 'odom', jumps, self._restart)
        # Odometry follows the clouds: its jump starts the session anew, theirs ends the waiting.
        self._watch_points = StreamWatch(
            self, self.diagnostics, 'points', 'restart', self._buffer.rewind
        )
        self._scans = self._worker('keyframes', self._make_keyframe, 5, lambda scan: None)
        self._searches = self._worker(
            'loop search', self._find_loops, self.config.waiting_searches, self._skip
        )
        self._keyframes_out = self.create_publisher(KeyframeMessage, 'keyframe', qos.RELIABLE)
        self._loops_out = self.create_publisher(
            LoopConstraintMessage, 'loop_constraint', qos.RELIABLE
        )
        self.create_subscription(
            PointCloud2, 'points', self.on_points, qos.sensor(self.config.reliable_points)
        )
        self.create_subscription(Odometry, 'odom', self.on_odom, qos.RELIABLE)
        self.create_subscription(
            PointCloud2, 'graph/keyframes', self.on_graph_keyframes, qos.LATCHED
        )
        if self._gate.settings.use:
            self.create_subscription(
                PlaceMatchArray, 'place_matches', self.on_place_matches, qos.RELIABLE
            )
            self.diagnostics.watch('keyframes waiting for place recognition', self._gate.__len__)
        self.create_service(LoadMap, '~/load_map', self.on_load_map)
        self.create_service(Trigger, '~/reset', self.on_reset)
        self.diagnostics.watch('clouds waiting for odometry', lambda: len(self._buffer))
        self.diagnostics.watch('scans waiting to become keyframes', self._scans.waiting)
        self.diagnostics.watch('keyframes waiting for the search', self._searches.waiting)
        self.diagnostics.watch('keyframes remembered', lambda: self._remembered)
        # The last one, as nobody would end the process of a node that was not made.
        self._beside = SearchProcess(detector) if self.config.beside else None
        self._under_way: _Scan | None = None

    def on_points(self, message: PointCloud2) -> None:
        """Let a cloud wait for its odometry."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if self._watch_points.takes(stamp_ns):
            self.diagnostics.tick('points', stamp_ns)
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
            self._frames = (message.header.frame_id, message.child_frame_id or 'base_link')
            self._choose(self._buffer.add_pose(pose))
            self._gate.time(pose.stamp_ns)
            last = self._under_way
            if last is not None and pose.stamp_ns - last.pose.stamp_ns > _LONGEST_BESIDE_NS:
                self.flush()

    def on_graph_keyframes(self, message: PointCloud2) -> None:
        """Remember where the pose graph has the keyframes, for the radius search."""
        try:
            self._graph = positions_from_message(message)
        except DataError as error:
            self._reject('graph/keyframes', 'broken', str(error))

    def on_place_matches(self, message: PlaceMatchArray) -> None:
        """Let the keyframes go on that waited for this answer."""
        verdict = place_verdict(message)
        self.diagnostics.tick('place_matches', verdict.stamp_ns)
        self._gate.answer(verdict)

    def on_load_map(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """Start a session that continues a saved map."""
        try:
            self._start(request.path)
        except MapError as error:
            response.success, response.message = False, str(error)
            return response
        self._reset_watches()
        response.success = True
        response.message = f'{self._session.first_id} keyframes loaded from {request.path}'
        return response

    def on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget all keyframes, those of a loaded map too."""
        self._start('')
        self._buffer.clear()
        self._reset_watches()
        response.success, response.message = True, 'loop closure starts again'
        return response

    def flush(self) -> None:
        """Publish what the process beside has found, when it is done; nothing is held back then.

        Raises:
            SearchProcessError: the process ended, and the keyframes are lost.
        """
        scan = self._under_way
        if self._beside is None or scan is None:
            return
        with self.diagnostics.stage('wait'):
            found = self._beside.result()
        self._under_way = None
        if found is None:
            return  # Ctrl-C cut the connection
        for stage, seconds in found.times:
            self.diagnostics.time(stage, seconds)
        self._remembered = found.size
        if scan.session is self._session:
            self._publish_found(scan, found)
        else:
            self.diagnostics.count('dropped keyframes: their session ended')

    def destroy_node(self) -> None:
        """Stop the workers and the process, then the node."""
        self._scans.stop()
        self._searches.stop()
        if self._beside is not None:
            self._beside.close()
        super().destroy_node()

    def _restart(self, stamp_ns: int) -> None:
        self._start(self._map_path)
        self._buffer.rewind(stamp_ns)

    def _start(self, path: str) -> None:
        loaded = load_map(path).keyframes() if path else ()
        self._map_path = path
        if loaded:
            self.get_logger().info(f'{path}: looking for loops with {len(loaded)} keyframes')
        self._session = Session(loaded)
        self._selector.reset()
        self._gate.clear()
        self._graph = None

    def _reset_watches(self) -> None:
        self._watch_odom.reset()
        self._watch_points.reset()

    def _choose(self, paired: list[Paired[PointCloud2]]) -> None:
        for _, why in self._buffer.unpaired:
            self._reject('points', why.value, f'a cloud was dropped: {why.value}')
        self._buffer.unpaired.clear()
        for pair in paired:
            if self._selector.due(pair.pose.T_odom_base):
                self._take(pair.item, pair.pose)

    def _take(self, points: PointCloud2, pose: StampedPose) -> None:
        base_frame, frame_id = self._frames[1], points.header.frame_id
        T_base_lidar = self._transforms.lookup(base_frame, frame_id)
        problem = None
        if T_base_lidar is None:
            problem = f'/tf_static does not connect {base_frame} with {frame_id}: no keyframes'
            self._reject('points', 'no transform', problem)
        self.diagnostics.error('transform', problem)
        if T_base_lidar is not None:
            self._selector.take(pose.T_odom_base)
            self.flush()
            self._scans.put(_Scan(self._session, pose, points, T_base_lidar, self._frames))

    def _make_keyframe(self, scan: _Scan) -> None:
        if scan.session is not self._session:
            return
        try:
            cloud = messages.cloud_from_message(scan.points).finite()
        except DataError as error:
            self._reject('points', 'broken', str(error))
            return
        cloud, origin = cloud.transformed(scan.T_base_lidar), scan.T_base_lidar[:3, 3]
        if self._beside is not None:
            self._under_way = scan
            self._beside.hand_over(scan.session, Sweep(scan.pose, cloud, origin, self._graph))
            return
        assert self._search is not None
        try:
            keyframe = self._search.keyframe(scan.session, scan.pose, cloud)
        except DataError as error:
            self._reject('points', 'too few', str(error))
            return
        if keyframe is None:
            self._reject('points', 'empty', 'a cloud has no points in range')
            return
        self._publish_keyframe(keyframe, scan)
        job = SearchJob(scan.session, keyframe, origin, None)
        if self._gate.settings.use:
            self._gate.hold(keyframe.stamp_ns, job)
        else:
            self._searches.put(job)

    def _publish_found(self, scan: _Scan, found: Found) -> None:
        if found.keyframe is not None:
            self._publish_keyframe(found.keyframe, scan)
        if found.failed:
            what = 'keyframes' if found.keyframe is None else 'loop search'
            self._reject(what, 'failed', found.failed)
        elif found.refused:
            self._reject('points', 'too few', found.refused)
        elif found.keyframe is None:
            self._reject('points', 'empty', 'a cloud has no points in range')
        self._publish_loops(found.loops, scan.session)

    def _publish_keyframe(self, keyframe: Keyframe, scan: _Scan) -> None:
        self._keyframes_out.publish(keyframe_message(keyframe, *scan.frames))
        self.diagnostics.tick('keyframe', keyframe.stamp_ns)

    def _publish_loops(self, loops: Iterable[LoopConstraint], session: Session) -> None:
        for loop in loops:
            self.diagnostics.count(f'loops {loop.status.name.lower()}')
            if session is self._session:
                self._loops_out.publish(loop_message(loop, self._frames[1]))

    def _search_gated(self, job: SearchJob, verdict: PlaceVerdict | None) -> None:
        if verdict is None:
            self.diagnostics.count('keyframes searched without an answer of place recognition')
        elif verdict.rejected is not None:
            self.diagnostics.count('keyframes rejected by place recognition')
        self._searches.put(replace(job, verdict=verdict))

    def _skip(self, job: SearchJob) -> None:
        self.diagnostics.count('dropped searches: machine too slow')
        self._unsearched.append(replace(job, search=False))

    def _find_loops(self, job: SearchJob) -> None:
        if job.session is not self._session:
            return
        assert self._search is not None
        while self._unsearched:
            skipped = self._unsearched.popleft()
            if skipped.session is job.session:
                self._search.run(skipped)
        with self.diagnostics.stage('search'):
            loops = self._search.run(replace(job, graph=self._graph))
        self._remembered = self._search.size
        self._publish_loops(loops, job.session)

    def _worker(self, name: str, work: Any, capacity: int, on_drop: Any) -> Worker[Any]:
        def dropped(item: Any) -> None:
            self.diagnostics.count(f'dropped {name}: queue full')
            on_drop(item)

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
        node = LoopClosureNode()
        lower_priority(node.config.niceness)
        return node

    return run_node(make, __doc__ or '', argv)
