"""Grow a map from keyframes and loops as they come, in whatever order they come."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.compact_cloud import CompactCloud, compact
from lcd_loop_closure.corrected_pose import CorrectedPose
from lcd_loop_closure.gnss import GnssFix
from lcd_loop_closure.graph_noise import diagonal
from lcd_loop_closure.graph_settings import GraphSettings
from lcd_loop_closure.imu_preintegration import ImuConfig
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.map_store import Descriptor, SavedMap
from lcd_loop_closure.session_anchor import AnchorConfig, SessionAnchor

Taken = Literal['in', 'waits', 'remembered', 'unknown keyframe']


@config
class OnlineMapConfig:
    """What may wait, and for how much of it there is room."""

    waiting_loops: int = setting(100, 'loops that may wait for their keyframes', low=1)
    unplaced_keyframes: int = setting(
        500, 'keyframes that may wait until a session is found in its loaded map', low=1
    )
    shown_candidates: int = setting(500, 'rejected candidates kept to be shown', low=0)
    session_distance: float = setting(
        5.0, 'uncertainty of where a session starts in a loaded map', unit='m', low=0.1
    )
    session_angle: float = setting(
        0.3, 'uncertainty of how a session starts in a loaded map', unit='rad', low=0.01
    )


class OnlineMap:
    """Hold the pose graph with the clouds and descriptors of its keyframes.

    After `load` the next keyframes belong to a new session, of which nobody knows where in the map
    it is. They wait until loops with the map agree (`SessionAnchor`) or a person says (`place`);
    then they enter as a chain that hangs on a weak link, and the graph goes on as one.
    """

    _anchor: SessionAnchor | None  # while a session waits for its place

    def __init__(
        self,
        settings: OnlineMapConfig,
        graph: GraphSettings,
        anchor: AnchorConfig,
        count: Callable[[str], None],
    ) -> None:
        """Make an empty map; `count` is called with the cause of everything that is left out."""
        self._settings, self._graph_settings, self._anchor_settings = settings, graph, anchor
        self._count = count
        self._imu: tuple[ImuConfig, se3.Array] | None = None
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.graph = self._graph_settings.make()
        self._inertial = self._imu is not None
        if self._imu is not None:
            self.graph.use_imu(*self._imu)
        self.candidates: deque[LoopConstraint] = deque(maxlen=self._settings.shown_candidates)
        self.last: Keyframe | None = None
        self.first_id = 0
        self._clouds: dict[int, CompactCloud] = {}
        self._descriptors: dict[int, Descriptor | None] = {}
        self._waiting: deque[LoopConstraint] = deque()
        self._end_search()

    def __len__(self) -> int:
        return len(self._clouds)

    @property
    def next_id(self) -> int | None:
        """Id that the next keyframe must have at least; None when any will do."""
        newest = self._unplaced[-1] if self._unplaced else self.last
        return None if newest is None else newest.id + 1

    def starts_again(self, keyframe: Keyframe) -> bool:
        """Tell whether a keyframe has the first id of this session, which goes on already."""
        return keyframe.id == self.first_id and (self.next_id or 0) > self.first_id

    @property
    def located(self) -> bool:
        """False while a new session waits for its place in the loaded map."""
        return self._anchor is None

    @property
    def waiting_loops(self) -> int:
        """Number of loops whose keyframes have not come, or wait for their place themselves."""
        return len(self._waiting) + len(self._unplaced_loops)

    @property
    def unplaced_keyframes(self) -> int:
        """Number of keyframes of a new session that wait for its place in the loaded map."""
        return len(self._unplaced)

    @property
    def T_map_odom(self) -> se3.Array | None:
        """The correction of odometry; None while the session is not located."""
        return self.graph.T_map_odom if self.located else None

    @property
    def nbytes(self) -> int:
        """Memory of clouds and descriptors, bytes."""
        descriptors = sum(d.values.nbytes for d in self._descriptors.values() if d is not None)
        return descriptors + sum(cloud.nbytes for cloud in self._clouds.values())

    @property
    def points_of(self) -> Callable[[int], NDArray[np.float32]]:
        """Return what gives the points [N x 3] of a keyframe (base frame, metres) by its id.

        It stays with this map's keyframes when another map is loaded; other threads may call it.
        """
        clouds = self._clouds
        return lambda keyframe_id: clouds[keyframe_id].xyz()

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Append a keyframe and the loops that waited for it.

        Raises:
            DataError: its id or stamp does not increase.
        """
        if self.next_id is not None and keyframe.id < self.next_id:
            raise DataError(
                f'expected a keyframe with the id {self.next_id} or more, got {keyframe.id}'
            )
        if self._anchor is not None:
            self._unplaced.append(keyframe)
            if len(self._unplaced) > self._settings.unplaced_keyframes:
                self._unplaced.popleft()
                self._count('dropped keyframes: session not found in the map')
        else:
            self._append(keyframe)
        waiting, self._waiting = self._waiting, deque()
        for loop in waiting:
            self.add_loop(loop)

    def add_loop(self, loop: LoopConstraint) -> Taken:
        """Offer a loop to the graph; one that came before its keyframes waits for them.

        Raises:
            DataError: it has no transform.
        """
        if not loop.accepted:
            self.candidates.append(loop)
            return 'remembered'
        if loop.T_match_query is None:
            raise DataError(f'loop {loop.match_id} - {loop.query_id} is accepted without transform')
        newest = max(loop.match_id, loop.query_id)
        if self.next_id is None or newest >= self.next_id:
            if len(self._waiting) >= self._settings.waiting_loops:
                self._waiting.popleft()
                self._count('dropped loops: keyframe did not come')
            self._waiting.append(loop)
            return 'waits'
        if self._anchor is not None and loop.query_id not in self._clouds:
            return self._locate(loop)
        if loop.match_id not in self._clouds or loop.query_id not in self._clouds:
            self._count('rejected loops: unknown keyframe')
            return 'unknown keyframe'
        self.graph.add_loop(loop)
        return 'in'

    def add_loop_by_hand(
        self, match_id: int, query_id: int, T_match_query: se3.Array, covariance: se3.Array
    ) -> None:
        """Put a loop in that a person knows to be right.

        Raises:
            DataError: a keyframe is unknown.
        """
        graph = self.graph
        stamps_ns = dict(zip(graph.ids.tolist(), graph.stamps_ns.tolist(), strict=True))
        loop = LoopConstraint(
            match_id=match_id,
            query_id=query_id,
            match_stamp_ns=stamps_ns.get(match_id, 0),
            query_stamp_ns=stamps_ns.get(query_id, 0),
            T_match_query=T_match_query,
            covariance=covariance,
            method='by hand',
        )
        graph.add_loop(loop, by_hand=True)

    def add_gnss(self, fix: GnssFix, T_base_antenna: se3.Array, T_odom_base: se3.Array) -> None:
        """Tie the newest keyframe to a fix, by the motion of odometry from it to the fix.

        Raises:
            DataError: the fix cannot be used.
        """
        if self.last is None or not self.located:
            raise DataError('a satellite fix came before the first keyframe')
        T_keyframe_base = se3.inverse(self.last.T_odom_base) @ T_odom_base
        self.graph.add_gnss(fix, T_base_antenna, T_keyframe_base)

    def use_imu(self, settings: ImuConfig, T_base_imu: se3.Array) -> bool:
        """Use an inertial sensor in this map and those after it; False in one that has begun.

        Only the first call counts.
        """
        if self._imu is None:
            self._imu = settings, T_base_imu
            if not len(self.graph):
                self.graph.use_imu(settings, T_base_imu)
                self._inertial = True
        return self._inertial

    def corrected_pose(self, newest: tuple[int, StampedPose] | None) -> CorrectedPose:
        """Return the newest keyframe as the graph sees it.

        `newest` is a keyframe's id with odometry, its covariance included, at that time; that of
        another keyframe is not used.
        """
        assert self.last is not None
        keyframe = StampedPose(self.last.stamp_ns, self.last.T_odom_base)
        if newest is not None and newest[0] == self.last.id:
            keyframe = newest[1]
        covariance = self.graph.covariance(self.last.id)
        return CorrectedPose(self.graph.T_map_odom, covariance, keyframe)

    def place(self, T_map_odom: se3.Array) -> None:
        """Attach the waiting session where somebody says that it is."""
        unplaced, loops = list(self._unplaced), self._unplaced_loops
        self._end_search()
        s = self._settings
        for first, keyframe in enumerate(unplaced):
            if first == 0 and self.last is not None:
                T_map_last = self.graph.poses()[-1]
                T_last_this = se3.inverse(T_map_last) @ T_map_odom @ keyframe.T_odom_base
                weak = diagonal(s.session_distance, s.session_angle)
                keyframe = replace(keyframe, T_previous_this=T_last_this, motion_covariance=weak)
                self._add(keyframe, new_session=True)
            else:
                self._append(keyframe)
        for loop in loops:
            self.add_loop(loop)

    def saved(self) -> SavedMap:
        """Return everything that a saved map holds; nothing in it changes later."""
        graph = self.graph.snapshot()
        ids = graph.ids.tolist()
        return SavedMap(
            graph,
            tuple(self._clouds[i] for i in ids),
            tuple(self._descriptors[i] for i in ids),
        )

    def load(self, saved: SavedMap) -> None:
        """Replace everything by a saved map; the next keyframe starts a new session in it."""
        graph = self._graph_settings.restore(saved.graph)  # may raise: then all stays
        self.clear()
        self.graph, self._inertial = graph, False
        ids = saved.graph.ids.tolist()
        self._clouds = dict(zip(ids, saved.clouds, strict=True))
        self._descriptors = dict(zip(ids, saved.descriptors, strict=True))
        if ids:
            self.last = saved.keyframe(len(ids) - 1)
            self.first_id = self.last.id + 1
            self._anchor = SessionAnchor(self._anchor_settings)

    def _append(self, keyframe: Keyframe) -> None:
        """Tie a keyframe to the last one, also when those between did not come."""
        if self.last is not None and keyframe.id != self.last.id + 1:
            self._count('keyframes missed')
        self._add(keyframe)

    def _add(self, keyframe: Keyframe, *, new_session: bool = False) -> None:
        self.graph.add_keyframe(keyframe, new_session=new_session)
        self._clouds[keyframe.id] = compact(keyframe.cloud)
        self._descriptors[keyframe.id] = (
            None
            if keyframe.descriptor is None
            else Descriptor(keyframe.descriptor_method, keyframe.descriptor)
        )
        self.last = replace(keyframe, cloud=_NO_POINTS, descriptor=None)

    def _locate(self, loop: LoopConstraint) -> Taken:
        """Ask the anchor whether a loop of the waiting session with the map tells where it is."""
        query = next((k for k in self._unplaced if k.id == loop.query_id), None)
        if query is None:
            self._count('rejected loops: unknown keyframe')
            return 'unknown keyframe'
        self._unplaced_loops.append(loop)
        assert self._anchor is not None and loop.T_match_query is not None
        if loop.match_id in self._clouds:
            graph = self.graph
            T_map_match = graph.poses()[int(np.searchsorted(graph.ids, loop.match_id))]
            T_map_odom = self._anchor.add(
                loop.query_id, T_map_match, loop.T_match_query, query.T_odom_base
            )
            if T_map_odom is not None:
                self.place(T_map_odom)
                return 'in'
        return 'waits'

    def _end_search(self) -> None:
        self._anchor = None
        self._unplaced: deque[Keyframe] = deque()
        self._unplaced_loops: deque[LoopConstraint] = deque(maxlen=self._settings.waiting_loops)


_NO_POINTS = PointCloud(np.empty((0, 3), np.float32))
