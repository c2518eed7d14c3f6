"""Check what the node of place recognition answers to a drive that passes a place twice."""

import numpy as np
import pytest

pytest.importorskip('rclpy')

from bags.records import LidarScan
from bags.street.drive import StreetDrive
from benchmarks.nodes.place_replay import answers_of
from benchmarks.place_real import _draw_answers

TWICE = 8
LATER_NS = 100_000_000 * TWICE


class ThereAndThereAgain(StreetDrive):
    """The first scans of the street, and the same ones later."""

    def records(self, *span, **kinds):
        first = []
        for record in super().records(*span, **kinds):
            if isinstance(record, LidarScan):
                first.append(record)
                yield record
            if len(first) == TWICE:
                break
        for scan in first:
            yield LidarScan(scan.stamp_ns + LATER_NS, scan.cloud, scan.frame_id)


def test_answers_name_the_scan_that_was_there_before(tmp_path):
    drive = ThereAndThereAgain()
    truth = drive.truth()
    stamps = [record.stamp_ns for record in drive.records()]
    first = [T for _, T in zip(range(TWICE), truth.T_world_body, strict=False)]
    poses = dict(zip(stamps, [*first, *first], strict=True))
    found = answers_of(drive, poses, asked__distance=0.1, places__distance=0.1, recognizer__delay=0)
    assert len(found.places_ns) >= 2
    again = np.isin(found.stamps_ns, stamps[TWICE:])
    assert again.any()
    # The very same scan was there, where it became a place.
    placed = np.isin(found.stamps_ns[again] - LATER_NS, found.places_ns)
    np.testing.assert_array_equal(
        found.found_ns[again][placed], found.stamps_ns[again][placed] - LATER_NS
    )
    assert (found.similarity[again][placed] > 0.999).all()
    assert ((found.wrong_probability >= 0.0) & (found.wrong_probability <= 1.0)).all()
    right = np.ones(len(found.stamps_ns), bool)
    _draw_answers(found, right, right, 'street', tmp_path / 'answers.png')
    assert (tmp_path / 'answers.png').stat().st_size > 10_000
