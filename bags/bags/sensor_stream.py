"""Hold one sensor's recording as an index of stamps and a way to read each entry."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.records import LidarScan, Record, Stream
from bags.skips import Skips, UnreadableError
from bags.topics import ORDER, TOPICS
from lcd_common.errors import DataError


@dataclass(frozen=True)
class SensorStream:
    """What one sensor recorded, in stamp order, read entry by entry.

    Attributes:
        kind: the type of its records.
        source: the folder or file it comes from, for messages.
        stamps_ns: [N] int64, strictly increasing.
        entries: [N] the number that `read` takes for each stamp.
        read: reads one entry given its number and stamp; raises UnreadableError.
    """

    kind: type[Record]
    source: str
    stamps_ns: NDArray[np.int64]
    entries: NDArray[np.int64]
    read: Callable[[int, int], Record]

    def describe(self) -> Stream:
        """Return topic, type, count and span."""
        topic, type_name = TOPICS[self.kind]
        if not len(self.stamps_ns):
            return Stream(topic, type_name, 0, None, None)
        first, last = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        return Stream(topic, type_name, len(self.stamps_ns), first, last)

    def between(
        self, start_ns: int | None, end_ns: int | None, skips: Skips
    ) -> Iterator[tuple[int, int, Record]]:
        """Yield (stamp, order among equal stamps, record) of a span, both ends inclusive.

        Raises:
            DataError: it holds sweeps, and not one of those in the span can be read.
        """
        first = 0 if start_ns is None else int(np.searchsorted(self.stamps_ns, start_ns))
        end = len(self.stamps_ns)
        if end_ns is not None:
            end = int(np.searchsorted(self.stamps_ns, end_ns, side='right'))
        yielded, failure = 0, ''
        for position in range(first, end):
            stamp, entry = int(self.stamps_ns[position]), int(self.entries[position])
            try:
                record = self.read(entry, stamp)
                if isinstance(record, LidarScan):
                    record = without_broken_points(record, self.source, skips)
            except UnreadableError as error:
                skips.add(error.cause, (self.source, entry), str(error))
                failure = failure or str(error)
                continue
            yielded += 1
            yield stamp, ORDER[self.kind], record
        if self.kind is LidarScan and failure and not yielded:
            raise DataError(
                f'{self.source}: none of the {end - first} scans can be read; the first: {failure}'
            )


def make_stream(
    kind: type[Record],
    source: str,
    stamps_ns: Sequence[int] | NDArray[np.int64],
    entries: Sequence[int] | NDArray[np.int64],
    read: Callable[[int, int], Record],
    skips: Skips,
) -> SensorStream:
    """Sort entries by stamp and leave out those that repeat one (the first is kept), counted."""
    stamps = np.asarray(stamps_ns, np.int64)
    order = np.argsort(stamps, kind='stable')
    stamps, ordered = stamps[order], np.asarray(entries, np.int64)[order]
    back = int(np.count_nonzero(np.diff(order) < 0))
    if back:
        skips.note(f'{source}: stamps go backwards at {back} places; read in stamp order')
    keep = np.ones(len(stamps), bool)
    keep[1:] = np.diff(stamps) > 0
    for entry in ordered[~keep]:
        skips.add(
            'duplicate stamp', (source, int(entry)), f'{source}: entry {entry} repeats a stamp'
        )
    return SensorStream(kind, source, stamps[keep], ordered[keep], read)


def without_broken_points(scan: LidarScan, source: str, skips: Skips) -> LidarScan:
    """Drop NaN and infinite points, counted; a sweep without any point raises UnreadableError."""
    cloud = scan.cloud.finite()
    dropped = len(scan.cloud) - len(cloud)
    if dropped:
        skips.add(
            'points that are not finite',
            (source, scan.stamp_ns),
            f'{source}: the scan at {scan.stamp_ns} has {dropped} points that are not finite',
            dropped,
        )
    if not len(cloud):
        raise UnreadableError(
            'scan without points', f'{source}: the scan at {scan.stamp_ns} is empty'
        )
    return LidarScan(scan.stamp_ns, cloud, scan.frame_id) if dropped else scan
