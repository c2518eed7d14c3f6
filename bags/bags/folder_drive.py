"""Read a drive that is stored as folders of files, whatever the data set."""

import heapq
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from bags.records import CameraModel, Mounting, Record, Stream, TruthPose
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips
from lcd_common import se3
from lcd_common.trajectory import Trajectory


class FolderDrive:
    """A drive made of sensor streams; what a data set's `open_…` function returns.

    Only the stamps are held in memory; sweeps and images are read when their turn comes.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        streams: Sequence[SensorStream],
        skips: Skips,
        *,
        mountings: tuple[Mounting, ...] = (),
        camera: CameraModel | None = None,
        truth: Trajectory | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.name = name
        self.path = path
        self.mountings = mountings
        self.camera = camera
        self.notes = notes
        self._truth = truth if truth is not None and len(truth) else None
        self.skipped: Counter[str] = skips.counts
        self._skips = skips
        self._streams = [stream for stream in streams if len(stream.stamps_ns)]
        if self._truth is not None:
            self._streams.append(_truth_stream(self._truth, str(path), skips))

    def streams(self) -> list[Stream]:
        """List what the drive holds, without reading the sensors' data."""
        return [stream.describe() for stream in self._streams]

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield everything between two stamps (inclusive) in stamp order, one sweep at a time.

        With `kinds` only these are read.

        Raises:
            DataError: not one sweep of the span can be read.
        """
        parts = [
            stream.between(start_ns, end_ns, self._skips)
            for stream in self._streams
            if kinds is None or stream.kind in kinds
        ]
        for _, _, record in heapq.merge(*parts, key=lambda item: item[:2]):
            yield record

    def truth(self) -> Trajectory | None:
        """Return the reference trajectory of base_link, or None when there is none."""
        return self._truth


def _truth_stream(truth: Trajectory, source: str, skips: Skips) -> SensorStream:
    poses: se3.Array = truth.T_world_body

    def read(entry: int, stamp_ns: int) -> Record:
        return TruthPose(stamp_ns, poses[entry])

    return make_stream(TruthPose, source, truth.stamps_ns, np.arange(len(truth)), read, skips)
