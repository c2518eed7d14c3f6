"""Describe sweeps and look for their loops in a process of its own, while the caller goes on.

The bindings of KISS-ICP and small_gicp hold the interpreter lock for whole calls: on threads they
would wait for each other. The child is a plain one, as that of verdict_process: it never runs the
caller's script again, and it ends when the caller does, however that ends.
"""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError, LocalizationError
from lcd_common.stamp_buffer import StampedPose
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.loop_detector import LoopDetectorSettings
from lcd_loop_closure.loop_search import LoopSearch, SearchJob, Session
from lcd_loop_closure.radius_search import GraphPositions

_CHILD = f'from {__name__} import main; main()'  # run with -m, its classes would have other names


class SearchProcessError(LocalizationError):
    """The process ended; what it remembered is lost."""


@dataclass(frozen=True)
class Sweep:
    """A sweep that becomes a keyframe, and what is known at that time.

    Attributes:
        pose: of odometry at the sweep's stamp.
        cloud: in the base frame.
        sensor_origin: [3] position of the LiDAR in the base frame, metres.
        graph: the pose graph's positions; None before there are any.
    """

    pose: StampedPose
    cloud: PointCloud
    sensor_origin: NDArray[np.float64]
    graph: GraphPositions | None


@dataclass(frozen=True)
class Found:
    """What became of a sweep.

    Attributes:
        keyframe: without its features; None when the sweep gave none.
        loops: every candidate that was tried, with its verdict.
        refused: why a sweep gave no keyframe, when it has too few points to tell the place.
        failed: what broke in the work on it, for people; else empty.
        times: stages and their seconds, in the order in which they ended.
        size: number of remembered keyframes.
    """

    keyframe: Keyframe | None = None
    loops: tuple[LoopConstraint, ...] = ()
    refused: str = ''
    failed: str = ''
    times: tuple[tuple[str, float], ...] = ()
    size: int = 0


class SearchProcess:
    """Run a LoopSearch in a child process, one sweep at a time. Not thread-safe."""

    def __init__(self, settings: LoopDetectorSettings) -> None:
        """Start the child and wait until it is ready.

        Raises:
            LocalizationError: the search cannot be made, as LoopSearch says it.
        """
        self._session: Session | None = None
        self._asked = False
        self._child: subprocess.Popen[bytes] | None = None
        self._connection, childs = Pipe()
        with childs:
            self._child = subprocess.Popen(
                [sys.executable, '-c', _CHILD, str(childs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[childs.fileno()],
                env={**os.environ, 'OMP_NUM_THREADS': '1'},
                start_new_session=True,  # Ctrl-C is for the caller, which then closes the pipe
            )
        with self._closed_when_cut():
            with contextlib.suppress(OSError):  # a child that is gone has no answer either
                self._connection.send(settings)
            problem = self._receive()
        if problem is not None:
            self.close()
            raise problem

    def hand_over(self, session: Session, sweep: Sweep) -> None:
        """Have a sweep described and its loops looked for; the result before must be taken.

        Raises:
            SearchProcessError: the process has ended.
        """
        if self._asked:
            raise ValueError('the result of the sweep before was not taken')
        if self._child is None:
            raise SearchProcessError('the process that looks for loops has ended')
        # Sessions are told apart by identity, which does not travel: the child makes its own.
        loaded = None if session is self._session else session.loaded
        with self._closed_when_cut():
            with contextlib.suppress(OSError):  # a child that is gone shows in `result`
                self._connection.send((loaded, sweep))
            self._session, self._asked = session, True

    def result(self) -> Found | None:
        """Wait for the result of the sweep that was handed over; None when there is none.

        Ctrl-C during the wait loses nothing: the result can be taken later. In the middle of a
        message, which takes a millisecond, it ends the process.

        Raises:
            SearchProcessError: the process was killed, or fell over.
        """
        if not self._asked:
            return None
        self._connection.poll(None)
        with self._closed_when_cut():
            found: Found = self._receive()
            self._asked = False
        return found

    def close(self) -> None:
        """End the child; a result that was not taken is lost."""
        child, self._child, self._asked = self._child, None, False
        if child is not None:
            self._connection.close()
            child.kill()
            child.wait()

    def _receive(self) -> Any:
        child = self._child
        try:
            return self._connection.recv()
        except (EOFError, OSError):
            self.close()
            status = None if child is None else child.returncode
            raise SearchProcessError(
                f'the process that looks for loops ended (status {status}; -9 is often a lack of '
                'memory) and its keyframes are lost: drive again, with one thread to do without it'
            ) from None

    @contextlib.contextmanager
    def _closed_when_cut(self) -> Iterator[None]:
        """End the child when Ctrl-C may have left half a message in the connection."""
        try:
            yield
        except KeyboardInterrupt:
            self.close()
            raise


class _Searcher:
    """Do in the child what is asked of it, and note how long each stage takes."""

    def __init__(self, settings: LoopDetectorSettings) -> None:
        self._times: list[tuple[str, float]] = []
        self._search = LoopSearch(settings, self._timed)
        self._session = Session()

    def answer(self, loaded: tuple[Keyframe, ...] | None, sweep: Sweep) -> Found:
        """Return what becomes of a sweep; `loaded` is given with the first one of a session."""
        if loaded is not None:
            self._session = Session(loaded)
        self._times.clear()
        found = self._find(sweep)
        return replace(found, times=tuple(self._times), size=self._search.size)

    def _find(self, sweep: Sweep) -> Found:
        try:
            keyframe = self._search.keyframe(self._session, sweep.pose, sweep.cloud)
        except DataError as error:
            return Found(refused=str(error))
        except Exception as error:  # noqa: BLE001 - one bad sweep must not stop the drive
            return Found(failed=repr(error))
        if keyframe is None:
            return Found()
        found = Found(replace(keyframe, features=None))  # they do not travel
        job = SearchJob(self._session, keyframe, sweep.sensor_origin, sweep.graph)
        try:
            with self._timed('search'):
                return replace(found, loops=tuple(self._search.run(job)))
        except Exception as error:  # noqa: BLE001
            return replace(found, failed=repr(error))

    @contextlib.contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._times.append((stage, time.perf_counter() - start))


def serve(connection: Connection) -> None:
    """Answer sweeps until the connection ends; the settings come first."""
    try:
        searcher = _Searcher(connection.recv())
    except LocalizationError as error:
        connection.send(error)
        return
    connection.send(None)
    while True:
        connection.send(searcher.answer(*connection.recv()))


def main() -> None:
    """Serve on the connection that was handed down; what libraries print goes to standard error."""
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with contextlib.suppress(EOFError, OSError):  # the caller is gone
        serve(Connection(int(sys.argv[1])))
