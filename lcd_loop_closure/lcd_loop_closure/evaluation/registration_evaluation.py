"""Run a registration over pairs of scans, preparing each cloud once."""

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.baselines.registration import CloudRegistration
from lcd_loop_closure.evaluation.registration_errors import RegistrationErrors, errors_of
from lcd_loop_closure.evaluation.registration_pairs import RegistrationPairs

# Prepared clouds held at a time: pairs come by query, so matches move along a drive as well.
_HELD = 400


class PreparedClouds:
    """Prepare clouds when they are first asked for and hold the latest."""

    def __init__(
        self, registration: CloudRegistration, cloud_of: Callable[[int], PointCloud]
    ) -> None:
        self._registration, self._cloud_of = registration, cloud_of
        self._held: OrderedDict[int, Any] = OrderedDict()
        self.seconds, self.prepared = 0.0, 0

    def get(self, scan: int) -> Any:
        """Return a prepared scan."""
        if scan in self._held:
            self._held.move_to_end(scan)
            return self._held[scan]
        cloud = self._cloud_of(scan)
        start = time.perf_counter()
        ready = self._registration.prepare(cloud)
        self.seconds += time.perf_counter() - start
        self.prepared += 1
        self._held[scan] = ready
        if len(self._held) > _HELD:
            self._held.popitem(last=False)
        return ready


def evaluate_registration(
    registration: CloudRegistration,
    cloud_of: Callable[[int], PointCloud],
    pairs: RegistrationPairs,
    *,
    progress: Callable[[], None] = lambda: None,
) -> tuple[RegistrationErrors, list[se3.Array | None]]:
    """Register all pairs; return their errors and the poses T_match_query.

    A pair that a method cannot read (DataError, e.g. an empty cloud) is one without an answer.

    Args:
        registration: to judge.
        cloud_of: sweep of a scan, base frame.
        pairs: of scans, with the truth.
        progress: called after each pair.
    """
    clouds = PreparedClouds(registration, cloud_of)
    seconds = 0.0
    answers: list[se3.Array | None] = []
    for match, query in zip(pairs.match, pairs.query, strict=True):
        try:
            a, b = clouds.get(int(match)), clouds.get(int(query))
            start = time.perf_counter()
            answers.append(registration.register(a, b))
            seconds += time.perf_counter() - start
        except DataError:
            answers.append(None)
        progress()
    errors = errors_of(
        answers,
        pairs.T_match_query,
        1e3 * clouds.seconds / clouds.prepared if clouds.prepared else None,
        1e3 * seconds / len(pairs) if len(pairs) else None,
        yaw_only=getattr(registration, 'yaw_only', False),
    )
    return errors, answers
