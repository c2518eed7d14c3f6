"""Find out where in a loaded map the vehicle starts: recognise, register, and let scans agree."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.pair_registration import PairRegistration, PreparedCloud
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.session_anchor import AnchorConfig, SessionAnchor
from uncertain_place_recognition.place import Match, PlaceAnswer
from uncertain_place_recognition.place_recognizer import PlaceRecognizer


@config
class RelocalizerConfig:
    """When the vehicle counts as found in a loaded map."""

    scans: int = setting(2, 'scans whose registrations must agree', low=1)
    distance: float = setting(2.0, 'largest difference between them', unit='m', low=0.01)
    angle: float = setting(0.1, 'largest difference between them', unit='rad', low=0.001, high=3.2)
    tries: int = setting(3, 'matches of one scan that are registered', low=1)


@dataclass(frozen=True)
class Relocalized:
    """Where the vehicle is in the loaded map.

    Attributes:
        T_map_odom: where odometry's origin lies in the map.
        T_map_base: pose of the last scan, metres.
        covariance: 6x6 of T_map_base, body axes, translation first.
        place_id: the place that the scan was registered with.
    """

    T_map_odom: se3.Array
    T_map_base: se3.Array
    covariance: se3.Array
    place_id: int


class Relocalizer:
    """Register scans with the places they match until enough of them agree.

    A match is a place, not a pose: its heading is open, and in a town that repeats itself it may
    be another place. The registration of both clouds gives the pose and refuses most false ones;
    odometry between the scans refuses the rest. While a guarantee stands only accepted matches are
    tried, and without one all are: the checks after it do not rest on it.
    """

    cached = 16

    def __init__(
        self,
        recognizer: PlaceRecognizer,
        settings: RelocalizerConfig | None = None,
        reduction: ReductionConfig | None = None,
        *,
        sensor_origin: NDArray[np.float64] | None = None,
    ) -> None:
        """Make it for the map in the recognizer; `sensor_origin` [3] is the LiDAR's, base frame."""
        self.settings = settings or RelocalizerConfig()
        self._recognizer = recognizer
        self._reduction = reduction or ReductionConfig()
        self._pairs = PairRegistration(sensor_origin=sensor_origin)
        self._ready: OrderedDict[int, PreparedCloud] = OrderedDict()
        s = self.settings
        self._anchor = SessionAnchor(AnchorConfig(s.scans, s.distance, s.angle))
        self._scan = 0
        self.registered = 0

    def offer(
        self, answer: PlaceAnswer, cloud: PointCloud, T_odom_base: se3.Array
    ) -> Relocalized | None:
        """Take in a scan; return where it is once enough scans agree.

        Args:
            answer: of the recognizer to this scan.
            cloud: the sweep, base frame, metres.
            T_odom_base: odometry at the scan.
        """
        self._scan += 1
        query: PreparedCloud | None = None
        for match in self._worth_trying(answer):
            prepared = self._prepared(match.place_id)
            if prepared is None:
                continue
            if query is None:
                query = self._pairs.prepare(reduce_cloud(cloud, self._reduction).xyz)
            self.registered += 1
            pair = self._pairs.compare(prepared, query)
            if pair.T_match_query is None or pair.covariance is None:
                continue
            place = self._recognizer.place(match.place_id)
            T_map_odom = self._anchor.add(
                self._scan, place.T_map_base, pair.T_match_query, T_odom_base
            )
            if T_map_odom is None:
                return None  # one good registration of a scan is enough: the next scan confirms it
            covariance = pair.covariance
            if place.covariance is not None:
                covariance = se3.compose_covariance(
                    place.covariance, pair.T_match_query, pair.covariance
                )
            return Relocalized(T_map_odom, T_map_odom @ T_odom_base, covariance, place.id)
        return None

    def _worth_trying(self, answer: PlaceAnswer) -> list[Match]:
        if answer.withdrawn is None:
            return [match for match in answer.matches if match.accepted]
        return list(answer.matches[: self.settings.tries])

    def _prepared(self, id: int) -> PreparedCloud | None:
        ready = self._ready.pop(id, None)
        if ready is None:
            cloud = self._recognizer.cloud(id)
            if cloud is None:
                return None
            ready = self._pairs.prepare(cloud.xyz)
        self._ready[id] = ready
        while len(self._ready) > self.cached:
            self._ready.popitem(last=False)
        return ready
