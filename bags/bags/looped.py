"""Repeat a drive as one long drive."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bags.records import CameraModel, Drive, Mounting, Record, Stream
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

_GAP_NS = 100_000_000


class LoopedDrive:
    """Play a drive `rounds` times, each round's stamps shifted behind the last round's."""

    def __init__(self, drive: Drive, rounds: int) -> None:
        """Wrap a drive; raises DataError when it is empty."""
        self._drive, self._rounds = drive, rounds
        self.name: str = f'{drive.name} x {rounds}'
        self.path: Path = drive.path
        self.mountings: tuple[Mounting, ...] = drive.mountings
        self.camera: CameraModel | None = drive.camera
        self.skipped: Counter[str] = drive.skipped
        ends = [s for s in drive.streams() if s.first_ns is not None and s.last_ns is not None]
        if not ends:
            raise DataError(f'{drive.path}: the drive is empty, there is nothing to repeat')
        self._first_ns = min(s.first_ns for s in ends if s.first_ns is not None)
        last_ns = max(s.last_ns for s in ends if s.last_ns is not None)
        self.period_ns = last_ns - self._first_ns + _GAP_NS

    def streams(self) -> list[Stream]:
        """List what all rounds hold together."""
        later = (self._rounds - 1) * self.period_ns
        return [
            replace(
                stream,
                count=stream.count * self._rounds,
                last_ns=None if stream.last_ns is None else stream.last_ns + later,
            )
            for stream in self._drive.streams()
        ]

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield the records of every round between two (shifted) stamps, both inclusive."""
        for turn in range(self._rounds):
            shift = turn * self.period_ns
            begin_ns = self._first_ns + shift
            if end_ns is not None and begin_ns > end_ns:
                return
            if start_ns is not None and start_ns >= begin_ns + self.period_ns:
                continue
            for record in self._drive.records(
                None if start_ns is None or start_ns <= begin_ns else start_ns - shift,
                None if end_ns is None else end_ns - shift,
                kinds,
            ):
                yield replace(record, stamp_ns=record.stamp_ns + shift) if shift else record

    def truth(self) -> Trajectory | None:
        """Return the reference trajectory of all rounds, or None when there is none."""
        truth = self._drive.truth()
        if truth is None:
            return None
        shifts = np.arange(self._rounds, dtype=np.int64) * self.period_ns
        stamps = (truth.stamps_ns[None] + shifts[:, None]).ravel()
        return Trajectory(stamps, np.tile(truth.T_world_body, (self._rounds, 1, 1)))
