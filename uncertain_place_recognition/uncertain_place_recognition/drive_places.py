"""Follow one drive through the map: where it is, and which places it adds."""

import threading

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.keyframes import KeyframeConfig, KeyframeSelector
from lcd_loop_closure.radius_search import GraphPositions
from lcd_loop_closure.reduction import ReductionConfig
from uncertain_place_recognition.keyframe_poses import KeyframePoses
from uncertain_place_recognition.place import PlaceAnswer
from uncertain_place_recognition.place_recognizer import PlaceRecognizer
from uncertain_place_recognition.relocalizer import Relocalized, Relocalizer, RelocalizerConfig


@config
class AskedConfig(KeyframeConfig):
    """Which scans are asked about when odometry chooses them (follow: odom)."""

    distance: float = setting(3.0, 'travelled distance between scans', unit='m', low=0.1)
    angle: float = setting(0.5, 'turned angle between scans', unit='rad', low=0.01, high=3.15)


@config
class PlaceSpacingConfig(KeyframeConfig):
    """How far apart places lie: as the submaps of the calibration, or its promises do not fit.

    What speaks against a match is told from the ten best, and in a denser map all ten are of one
    place.
    """

    distance: float = setting(10.0, 'travelled distance between places', unit='m', low=0.1)
    angle: float = setting(0.5, 'turned angle between places', unit='rad', low=0.01, high=3.15)


class DrivePlaces:
    """From one start, reset, clock jump or loaded map to the next; told apart by identity.

    Without a loaded map, odometry's frame is the map's until the pose graph says otherwise. In a
    loaded map a drive adds places only once somebody knows where it lies there: the pose graph
    (with keyframes) or the relocalizer (without).
    """

    def __init__(
        self,
        recognizer: PlaceRecognizer,
        relocalizer: RelocalizerConfig | None,
        reduction: ReductionConfig,
        *,
        by_keyframes: bool,
        spacing: PlaceSpacingConfig | None = None,
    ) -> None:
        """Begin a drive in the recognizer's map; with `relocalizer` look for the vehicle in it.

        With `spacing` scans nearer to the last place are asked about, but not remembered.
        """
        self._recognizer, self._reduction = recognizer, reduction
        self._by_keyframes = by_keyframes
        loaded = recognizer.places()
        self._keyframes = KeyframePoses(loaded)
        self.first_id = (
            recognizer.next_id
        )  # keyframes of a session in this map are numbered from it
        self._T_map_odom: se3.Array | None = None if loaded else np.eye(4)
        self._search = relocalizer
        self._relocalizer: Relocalizer | None = None
        self._newest_id = -1
        self._lock = threading.Lock()
        self._spacing = None if spacing is None else KeyframeSelector(spacing)
        self.force_next = False

    @property
    def looking(self) -> bool:
        """True while the vehicle is looked for in the loaded map."""
        return self._search is not None

    def look_again(self, settings: RelocalizerConfig) -> None:
        """Look for the vehicle once more."""
        self._relocalizer, self._search = None, settings

    def starts_again(self, keyframe_id: int) -> bool:
        """Tell whether a keyframe's number says that its session began anew."""
        return keyframe_id <= self._newest_id

    def relocalize(
        self,
        answer: PlaceAnswer,
        cloud: PointCloud,
        T_odom_base: se3.Array,
        sensor_origin: NDArray[np.float64],
    ) -> Relocalized | None:
        """Return where the vehicle is, once, when it has been found; None while nobody looks."""
        settings = self._search
        if settings is None:
            return None
        if self._relocalizer is None:
            self._relocalizer = Relocalizer(
                self._recognizer, settings, self._reduction, sensor_origin=sensor_origin
            )
        found = self._relocalizer.offer(answer, cloud, T_odom_base)
        if found is not None:
            self._T_map_odom, self._search = found.T_map_odom, None
        return found

    def add(
        self,
        members: NDArray[np.float32],
        cloud: PointCloud,
        pose: StampedPose,
        keyframe_id: int | None,
    ) -> bool:
        """Remember a scan as a place.

        Returns:
            False when nobody knows where in the map it is, or when it is too near to the last one.

        Raises:
            DataError: the keyframe's number is taken.
        """
        forced, self.force_next = self.force_next, False
        T_map_base = self._place(pose, keyframe_id)
        if T_map_base is None:
            return False
        if self._spacing is not None:
            if not (forced or self._spacing.due(pose.T_odom_base)):
                return False
            self._spacing.take(pose.T_odom_base)
        self._recognizer.add(
            members,
            T_map_base,
            stamp_ns=pose.stamp_ns,
            id=keyframe_id,
            covariance=pose.covariance,
            cloud=cloud,
        )
        return True

    def T_map_base(self, T_odom_base: se3.Array, keyframe_id: int | None) -> se3.Array | None:
        """Return where the vehicle is in the map, as far as is known."""
        if keyframe_id is not None:
            with self._lock:
                known = self._keyframes.pose(keyframe_id)
            if known is not None:
                return known
        return None if self._T_map_odom is None else self._T_map_odom @ T_odom_base

    def corrected(self, graph: GraphPositions) -> dict[int, se3.Array]:
        """Take in the graph's positions; return T_map_base of the places that moved."""
        with self._lock:
            return self._keyframes.corrected(graph)

    def _place(self, pose: StampedPose, keyframe_id: int | None) -> se3.Array | None:
        if keyframe_id is None:
            return None if self._T_map_odom is None else self._T_map_odom @ pose.T_odom_base
        self._newest_id = max(self._newest_id, keyframe_id)
        with self._lock:
            self._keyframes.add(keyframe_id, pose.stamp_ns, pose.T_odom_base)
        return self.T_map_base(pose.T_odom_base, keyframe_id)
