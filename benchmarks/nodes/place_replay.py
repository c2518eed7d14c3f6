"""Replay a drive through the node of place recognition in lock-step, and keep its answers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bags.nodes.lockstep import LockStep
from bags.records import Drive
from benchmarks.nodes.given_odometry import GivenOdometryNode
from lcd_common import se3
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.offline_slam import own_context
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode


@dataclass(frozen=True)
class Answers:
    """Answers to N scans for which the map had a place.

    Attributes:
        stamps_ns: [N] of the scans.
        found_ns: [N] of the scan that the best match is.
        similarity, uncertainty, wrong_probability: [N] of the best match.
        accepted: [N] whether it may be believed.
        places_ns: stamps of all places that were remembered, in order.
    """

    stamps_ns: NDArray[np.int64]
    found_ns: NDArray[np.int64]
    similarity: NDArray[np.float64]
    uncertainty: NDArray[np.float64]
    wrong_probability: NDArray[np.float64]
    accepted: NDArray[np.bool_]
    places_ns: NDArray[np.int64]


def answers_of(
    drive: Drive,
    T_odom_base: Mapping[int, se3.Array] | None = None,
    odometry: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Answers:
    """Drive a recording through odometry and place recognition.

    Args:
        drive: with LiDAR.
        T_odom_base: poses by stamp, in the place of the suite's LiDAR odometry.
        odometry: parameters of the LiDAR odometry.
        settings: parameters of place recognition; a double underscore stands for a dot.
    """
    heard: list[Any] = []
    with own_context() as context:
        made: dict[str, Any] = {'context': context, 'use_global_arguments': False}
        first: Any
        if T_odom_base is not None:
            first = GivenOdometryNode(T_odom_base, **made)
        else:
            first = LidarOdometryNode(
                **made,
                parameter_overrides=overrides(threaded=False, threads=1, **(odometry or {})),
            )
        places = PlaceRecognitionNode(
            **made, parameter_overrides=overrides(threaded=False, **settings)
        )
        lockstep = LockStep((first, places))
        lockstep.listen('/place_matches', heard.append)
        try:
            lockstep.run(drive, progress=True)
            stamp_of = {place.id: place.stamp_ns for place in places.recognizer.places()}
        finally:
            for node in (first, places):
                node.destroy_node()
    asked = [message for message in heard if message.matches]
    best = [message.matches[0] for message in asked]
    return Answers(
        np.array([messages.stamp_ns(message.header.stamp) for message in asked], np.int64),
        np.array([stamp_of[match.place_id] for match in best], np.int64),
        np.array([match.similarity for match in best], np.float64),
        np.array([match.uncertainty for match in best], np.float64),
        np.array([match.false_match_probability for match in best], np.float64),
        np.array([match.accepted for match in best], bool),
        np.array(sorted(stamp_of.values()), np.int64),
    )
