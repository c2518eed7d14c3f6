"""Correct odometry by loops, and keep the map.

    ros2 run lcd_loop_closure pose_graph --ros-args --params-file config/pose_graph.yaml

Subscribes  keyframe (lcd_msgs/Keyframe), loop_constraint (lcd_msgs/LoopConstraint), odom
            (nav_msgs/Odometry), /tf_static, gps/fix (sensor_msgs/NavSatFix, with use_gps), imu
            (sensor_msgs/Imu, with use_imu), initialpose (geometry_msgs/PoseWithCovarianceStamped:
            where a session starts in a loaded map, at its stamp; from RViz or place_recognition)
Publishes   /tf map -> odom (with publish_tf), pose (geometry_msgs/PoseWithCovarianceStamped, at
            odometry's rate), path (nav_msgs/Path), graph/keyframes (sensor_msgs/PointCloud2: x y z
            id), loops (lcd_msgs/LoopConstraintArray: every loop with the latest verdict),
            loop_markers (visualization_msgs/MarkerArray: accepted green, rejected red), map
            (sensor_msgs/PointCloud2, only while somebody listens), /diagnostics
Services    ~/save_map (lcd_msgs/SaveMap), ~/load_map (lcd_msgs/LoadMap), ~/pause
            (std_srvs/SetBool), ~/reset (std_srvs/Trigger), ~/add_loop (lcd_msgs/AddLoop),
            ~/remove_loop (lcd_msgs/RemoveLoop)

A loop acts at once if it agrees with the estimate; all loops are judged together beside the
callbacks, and the verdict takes loops out of the graph or puts them back. Parameters: see
config/pose_graph.yaml or `ros2 param describe`.
"""

import math
import time
from collections import OrderedDict
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.nodes import messages, qos
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.nodes.parameters import declare_config
from lcd_common.nodes.spin import run_node
from lcd_common.nodes.transforms import StaticTransforms
from lcd_common.settings import config, setting
from lcd_loop_closure.graph_noise import GraphNoise
from lcd_loop_closure.graph_settings import GraphSettings
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.map_cloud import MapCloudConfig
from lcd_loop_closure.map_store import load_map
from lcd_loop_closure.nodes.conversions import keyframe_from_message, loop_from_message
from lcd_loop_closure.nodes.extra_sensors import ExtraSensors
from lcd_loop_closure.nodes.graph_display import GraphDisplay, Shown
from lcd_loop_closure.nodes.graph_judge import GraphJudge
from lcd_loop_closure.nodes.graph_watch import watch_graph
from lcd_loop_closure.nodes.group_parameters import declare_groups
from lcd_loop_closure.nodes.map_services import MapServices
from lcd_loop_closure.nodes.odometry_message import odometry_pose
from lcd_loop_closure.nodes.path_message import PathWriter
from lcd_loop_closure.nodes.pose_output import PoseOutput
from lcd_loop_closure.nodes.positions_message import positions_message
from lcd_loop_closure.nodes.stream_watch import StreamWatch
from lcd_loop_closure.online_map import OnlineMap, OnlineMapConfig
from lcd_loop_closure.pose_graph import PoseGraph
from lcd_loop_closure.robust_solver import RobustSolverConfig, Verdict
from lcd_loop_closure.session_anchor import AnchorConfig
from lcd_msgs.msg import Keyframe as KeyframeMessage
from lcd_msgs.msg import LoopConstraint as LoopConstraintMessage

_RECENT = 100  # odometry messages that an initial pose may refer to
_STILL = 2  # refreshes without a keyframe: the vehicle stands, or the drive is over


@config
class PoseGraphNodeConfig:
    """How the node runs; the settings of the graph and its parts are in groups beside these."""

    map: str = setting('', 'folder of a saved map to go on in from the start; empty: a new map')
    map_frame: str = setting('map', 'frame of the corrected poses')
    odom_frame: str = setting('odom', 'frame of odometry')
    publish_tf: bool = setting(True, 'own map -> odom; false when something else does')
    use_gps: bool = setting(False, 'tie keyframes to the satellite fixes of gps/fix')
    use_imu: bool = setting(
        False, 'tie keyframes by imu too, and level a new map by gravity (not in a loaded map)'
    )
    max_odometry_gap: float = setting(
        0.3, 'longest time between two odometry messages to interpolate over', unit='s', low=0.0
    )
    display_period: float = setting(
        1.0, 'shortest time between two loops, loop_markers', unit='s', low=0.0
    )
    map_period: float = setting(5.0, 'shortest time between two map clouds', unit='s', low=0.0)
    on_time_jump: str = setting(
        'restart', 'what to do when the clock jumps back', choices=('restart', 'refuse')
    )
    judge_period: float = setting(
        1.0,
        'shortest time between two joint verdicts while keyframes come, for each hundred loops',
        unit='s',
        low=0.0,
    )
    solver_niceness: int = setting(
        10, 'lower priority of the process that judges the loops', low=0, high=19
    )
    threaded: bool = setting(True, 'work beside the callbacks; false: inside, for lock-step replay')


class PoseGraphNode(Node):
    """See the module's documentation."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('pose_graph', **node_options)
        self.config = declare_config(self, PoseGraphNodeConfig)
        threaded = self.config.threaded
        graph = declare_groups(self, GraphSettings())
        self.diagnostics = Diagnostics(self)
        self.map = OnlineMap(
            declare_config(self, OnlineMapConfig, 'online_map'),
            graph,
            declare_config(self, AnchorConfig, 'anchor'),
            self.diagnostics.count,
        )
        self._transforms = StaticTransforms(self)
        gap_ns = round(self.config.max_odometry_gap * 1e9)
        self._pose = PoseOutput(
            self,
            self.diagnostics,
            GraphNoise(graph.noise),
            frames=(self.config.map_frame, self.config.odom_frame),
            publish_tf=self.config.publish_tf,
            max_gap_ns=gap_ns,
        )
        self._judge = GraphJudge(
            self,
            declare_config(self, RobustSolverConfig, 'solver'),
            threaded=threaded,
            niceness=self.config.solver_niceness,
            on_verdict=self._on_verdict,
            on_error=lambda error: self._reject('verdicts', 'solver failed', str(error)),
        )
        self._display = GraphDisplay(
            self,
            self.diagnostics,
            declare_config(self, MapCloudConfig, 'map_cloud'),
            self.config.map_frame,
            threaded=threaded,
        )
        self._sensors = ExtraSensors(
            self,
            self.map,
            self._transforms,
            self._reject,
            use_gps=self.config.use_gps,
            use_imu=self.config.use_imu,
            max_gap_ns=gap_ns,
        )
        self._watch_odom = StreamWatch(
            self, self.diagnostics, 'odom', self.config.on_time_jump, self._rewind
        )
        self.paused = False
        self.base_frame = 'base_link'
        self._recent: OrderedDict[int, se3.Array] = OrderedDict()  # T_odom_base by stamp
        self._shown_s = self._mapped_s = self._judged_s = -math.inf
        self._refreshed_at: Keyframe | None = None
        self._still = 0  # refreshes without a keyframe
        self._undrawn = self._unmapped = False
        self._path = PathWriter(self.config.map_frame)
        self._path_out = self.create_publisher(Path, 'path', qos.LATCHED)
        self._positions_out = self.create_publisher(PointCloud2, 'graph/keyframes', qos.LATCHED)
        self.create_subscription(KeyframeMessage, 'keyframe', self.on_keyframe, qos.RELIABLE)
        self.create_subscription(
            LoopConstraintMessage, 'loop_constraint', self.on_loop_constraint, qos.RELIABLE
        )
        self.create_subscription(Odometry, 'odom', self.on_odom, qos.RELIABLE)
        self.create_subscription(
            PoseWithCovarianceStamped, 'initialpose', self.on_initialpose, qos.RELIABLE
        )
        self.map_services = MapServices(self, threaded=threaded)
        # Steady: also while simulated time stands still somebody may want to see the map. Lock-step
        # fires what runs by its own clock.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self.refresh, clock=steady if threaded else None)
        watch_graph(self.diagnostics, self.map, self._judge, self._sensors)
        self._map_path = ''
        if self.config.map:
            self.restart(self.config.map)

    def on_keyframe(self, message: KeyframeMessage) -> None:
        """Append a keyframe to the map."""
        try:
            keyframe = keyframe_from_message(message)
        except DataError as error:
            self._reject('keyframe', 'broken', str(error))
            return
        if self.paused:
            self.diagnostics.count('ignored keyframes: paused')
            return
        if not self._same_session(keyframe):
            return
        self.diagnostics.tick('keyframe', keyframe.stamp_ns)
        self.base_frame = message.child_frame_id or self.base_frame
        self._sensors.base_frame = self.base_frame
        try:
            self.map.add_keyframe(keyframe)
        except DataError as error:
            self._reject('keyframe', 'out of order', str(error))
            return
        self._pose.add_keyframe(keyframe)
        self.update()

    def on_loop_constraint(self, message: LoopConstraintMessage) -> None:
        """Offer a loop to the graph."""
        if self.paused:
            self.diagnostics.count('ignored loops: paused')
            return
        try:
            taken = self.map.add_loop(loop_from_message(message))
        except (DataError, ValueError) as error:
            self._reject('loop_constraint', 'broken', str(error))
            return
        self.diagnostics.count(f'loops {taken}')
        if taken == 'in':
            self.update()
        self._show()

    def on_odom(self, message: Odometry) -> None:
        """Correct odometry: broadcast map -> odom and publish the pose."""
        try:
            pose = odometry_pose(message)
        except DataError as error:
            self._reject('odom', 'broken', str(error))
            return
        frame, expected = message.header.frame_id, self.config.odom_frame
        problem = None if frame == expected else f'odom is in {frame}, expected {expected}'
        self.diagnostics.error('odom_frame', problem and f'{problem}: set odom_frame')
        if problem is not None:
            self._reject('odom', 'wrong frame', f'{problem}: set odom_frame')
            return
        if not self._watch_odom.takes(pose.stamp_ns):
            return
        self.diagnostics.tick('odom', pose.stamp_ns)
        self._recent[pose.stamp_ns] = pose.T_odom_base
        while len(self._recent) > _RECENT:
            self._recent.popitem(last=False)
        self._sensors.add_odometry(pose)
        self._pose.publish(pose, self.map)

    def on_initialpose(self, message: PoseWithCovarianceStamped) -> None:
        """Attach a new session to the loaded map where somebody says that the vehicle is or was."""
        if self.map.located or not self._recent:
            self._reject('initialpose', 'not needed', 'initialpose: no session waits for its place')
            return
        try:
            T_map_base = messages.transform_from_pose(message.pose.pose)
        except DataError as error:
            self._reject('initialpose', 'broken', str(error))
            return
        stamp_ns = messages.stamp_ns(message.header.stamp)
        # A stamp that odometry does not know (zero, another clock) means now.
        T_odom_base = self._recent.get(stamp_ns, next(reversed(self._recent.values())))
        self.map.place(T_map_base @ se3.inverse(T_odom_base))
        self.update()

    def restart(self, path: str) -> None:
        """Start with an empty map, or in a saved one.

        Raises:
            MapError: there is no readable map; then nothing changes.
        """
        if path:
            self.map.load(load_map(path))
        else:
            self.map.clear()
        self._map_path = path
        self._watch_odom.reset()
        self._pose.forget()
        self.diagnostics.error('session', None)
        self.update()

    def update(self) -> None:
        """Take what came into the graph, publish the result, and have new loops judged."""
        waits = None if self.map.located else 'looking for the vehicle in the loaded map'
        self.diagnostics.warn('located', waits)
        with self.diagnostics.stage('graph update'):
            self.map.graph.update()
        self.publish_graph()
        self._have_judged()
        self._show()

    def publish_graph(self) -> None:
        """Publish path and keyframe positions, in the order of the keyframes."""
        graph, last = self.map.graph, self.map.last
        stamp_ns = 0 if last is None else last.stamp_ns
        self._pose.changed()
        self._undrawn = self._unmapped = True
        with self.diagnostics.stage('path'):
            poses, frame = graph.poses(), self.config.map_frame
            self._path_out.publish(self._path.write(poses, graph.stamps_ns, stamp_ns))
            self._positions_out.publish(positions_message(graph.ids, poses, stamp_ns, frame))

    def refresh(self) -> None:
        """Show what was held back, and say whether map -> odom has another owner."""
        self._judge.hand_over()
        # Nothing new for a while: what waits for its verdict need not wait longer.
        self._still = self._still + 1 if self.map.last is self._refreshed_at else 0
        self._refreshed_at = self.map.last
        self._have_judged(now=self._still >= _STILL)
        self._show(all_of_it=not self.config.threaded)
        self._pose.check_authority()

    def show(self, *, map_cloud: bool = False) -> None:
        """Publish loops, markers and (map_cloud) the map now, whoever listens."""
        graph, last = self.map.graph, self.map.last
        self._undrawn, self._shown_s = False, self._now_s()
        if map_cloud:
            self._unmapped, self._mapped_s = False, self._now_s()
        self._display.show(
            Shown(
                graph=graph,
                points_of=self.map.points_of,
                ids=graph.ids,
                T_map_base=graph.poses().copy(),
                loops=tuple(graph.loops()),
                candidates=tuple(self.map.candidates),
                stamp_ns=0 if last is None else last.stamp_ns,
                base_frame=self.base_frame,
                map_cloud=map_cloud,
            )
        )

    def destroy_node(self) -> None:
        """Stop the workers and the solver's process, then the node."""
        self._judge.stop()
        self._display.stop()
        super().destroy_node()

    def _same_session(self, keyframe: Keyframe) -> bool:
        """Tell whether a keyframe may enter; one that starts a session again restarts or not."""
        problem = None
        if self.map.starts_again(keyframe):
            problem = 'loop_closure started a new session'
            if self.config.on_time_jump == 'restart':
                self.get_logger().warning(f'{problem}: so does the map (on_time_jump: restart)')
                self.diagnostics.count('sessions restarted')
                self.restart(self._map_path)
                return True
            problem += ': refusing its keyframes until ~/reset is called (on_time_jump: refuse)'
        elif keyframe.id < self.map.first_id:
            problem = (
                f'a map is loaded, but keyframes are numbered from {keyframe.id}: load it in '
                'loop_closure too (its ~/load_map service or parameter map)'
            )
        self.diagnostics.error('session', problem)
        if problem is not None:
            self._reject('keyframe', 'other session', problem)
        return problem is None

    def _rewind(self, stamp_ns: int) -> None:
        """Forget odometry: the clock jumped back. The map waits for what loop_closure does."""
        self._pose.forget()
        self._sensors.rewind(stamp_ns)
        self._recent.clear()

    def _on_verdict(self, graph: PoseGraph, verdict: Verdict) -> None:
        if graph is not self.map.graph:
            return
        self.diagnostics.time('solver', verdict.seconds)
        with self.diagnostics.stage('verdict'):
            update = graph.apply(verdict)
        for kind, loops in (('in', update.loops_in), ('out', update.loops_out)):
            self.diagnostics.count(f'loops {kind} by verdict', len(loops))
        self.publish_graph()
        self._judge.consider(self.map.graph)
        self._show()

    def _show(self, *, all_of_it: bool = False) -> None:
        """Publish what people look at, as often as it is due, or all that was held back."""
        now_s = self._now_s()
        map_due = self._unmapped and now_s - self._mapped_s >= self.config.map_period
        map_due = map_due and self._display.map_wanted
        due = all_of_it or now_s - self._shown_s >= self.config.display_period
        if map_due or (self._undrawn and due):
            self.show(map_cloud=map_due)

    def _have_judged(self, *, now: bool = False) -> None:
        hundreds = max(1.0, len(self.map.graph.loops()) / 100.0)
        due = now or self._now_s() - self._judged_s >= self.config.judge_period * hundreds
        if due and self._judge.consider(self.map.graph):
            self._judged_s = self._now_s()

    def _now_s(self) -> float:
        """Return wall time, or in lock-step the newest keyframe's, so that runs repeat."""
        if self.config.threaded:
            return time.monotonic()
        return 0.0 if self.map.last is None else self.map.last.stamp_ns * 1e-9

    def _reject(self, what: str, cause: str, text: str) -> None:
        self.diagnostics.count(f'rejected {what}: {cause}')
        self.get_logger().warning(text, throttle_duration_sec=5.0)


def main(argv: list[str] | None = None) -> int:
    """Run the node alone."""
    return run_node(PoseGraphNode, __doc__ or '', argv)
