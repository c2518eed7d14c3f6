"""Solve in a process of its own, so that callbacks keep the interpreter to themselves.

GTSAM's bindings hold the interpreter lock for the whole of a solve. A thread would stop odometry's
callbacks for up to a second; a process does not. It is a plain child that reads snapshots from its
standard input: unlike multiprocessing it never runs the caller's script again, and it ends when the
caller does, however that ends. Snapshots and verdicts travel as npz files, each behind its length.
"""

import contextlib
import dataclasses
import io
import json
import os
import struct
import subprocess
import sys
from collections.abc import Mapping
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import LocalizationError
from lcd_common.priority import lower_priority
from lcd_loop_closure.graph_arrays import arrays_of, snapshot_from
from lcd_loop_closure.graph_snapshot import GraphSnapshot
from lcd_loop_closure.robust_solver import RobustSolver, RobustSolverConfig, Verdict

_LENGTH = struct.Struct('<Q')


class SolverProcessError(LocalizationError):
    """The solver's process ended or failed in a solve; the next solve gets a new process."""


class VerdictProcess:
    """Run a RobustSolver in a child process, which the first solve starts. Not thread-safe."""

    def __init__(self, settings: RobustSolverConfig, niceness: int = 5) -> None:
        """Remember the settings; `niceness` lowers the child's priority."""
        self._settings, self._niceness = settings, niceness
        self._child: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the child now, as its first seconds (imports) are busy ones."""
        self._running()

    def solve(self, snapshot: GraphSnapshot) -> Verdict:
        """Return the verdict on a snapshot.

        Raises:
            SolverProcessError: the process was killed, or the solve failed.
        """
        child = self._running()
        assert child.stdin is not None and child.stdout is not None
        try:
            _send(child.stdin, arrays_of(snapshot))
            answer = _receive(child.stdout)
        except (EOFError, OSError, ValueError):
            self.close()
            raise SolverProcessError(
                f'the solver of the pose graph ended (status {child.returncode}); it starts again '
                'with the next loop'
            ) from None
        if 'error' in answer:
            raise SolverProcessError(f'the solver of the pose graph failed: {answer["error"]}')
        return verdict_from(answer)

    def close(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is None:
            return
        child.kill()
        child.wait()
        for pipe in (child.stdin, child.stdout):
            with contextlib.suppress(OSError):  # unwritten bytes for a child that is gone
                if pipe is not None:
                    pipe.close()

    def _running(self) -> 'subprocess.Popen[bytes]':
        if self._child is None:
            settings = json.dumps(dataclasses.asdict(self._settings))
            self._child = subprocess.Popen(
                [sys.executable, '-m', __name__, settings, str(self._niceness)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, 'OMP_NUM_THREADS': '1'},
                start_new_session=True,  # Ctrl-C is for the node, which then closes the pipe
            )
        return self._child


def verdict_arrays(verdict: Verdict) -> dict[str, NDArray[Any]]:
    """Return a verdict as named arrays."""
    return {
        'accepted': np.array(sorted(verdict.accepted), np.int64).reshape(-1, 2),
        'rejected': np.array(list(verdict.rejected), np.int64).reshape(-1, 2),
        'reasons': np.array(list(verdict.rejected.values()), np.str_),
        'broken_links': np.array(verdict.broken_links, np.int64),
        'arrivals': np.array(verdict.arrivals),
        'ids': verdict.ids,
        'T_map_base': verdict.T_map_base,
        'iterations': np.array(verdict.iterations),
        'seconds': np.array(verdict.seconds),
    }


def verdict_from(arrays: Mapping[str, NDArray[Any]]) -> Verdict:
    """Return the verdict that `verdict_arrays` took apart."""
    rejected = [(int(match), int(query)) for match, query in arrays['rejected']]
    return Verdict(
        accepted=frozenset((int(match), int(query)) for match, query in arrays['accepted']),
        rejected=dict(zip(rejected, map(str, arrays['reasons']), strict=True)),
        broken_links=tuple(arrays['broken_links'].tolist()),
        arrivals=int(arrays['arrivals']),
        ids=arrays['ids'],
        T_map_base=arrays['T_map_base'],
        iterations=int(arrays['iterations']),
        seconds=float(arrays['seconds']),
    )


def serve(solver: RobustSolver, requests: IO[bytes], answers: IO[bytes]) -> None:
    """Answer snapshots with verdicts until the requests end; a failed solve answers `error`."""
    while True:
        try:
            arrays = _receive(requests)
        except EOFError:
            return
        try:
            answer = verdict_arrays(solver.solve(snapshot_from(arrays)))
        except Exception as error:  # noqa: BLE001 - the caller decides what a failure means
            answer = {'error': np.array(repr(error))}
        _send(answers, answer)


def _send(pipe: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    pipe.write(_LENGTH.pack(len(buffer.getbuffer())))
    pipe.write(buffer.getbuffer())
    pipe.flush()


def _receive(pipe: IO[bytes]) -> dict[str, NDArray[Any]]:
    length = _LENGTH.unpack(_exactly(pipe, _LENGTH.size))[0]
    with np.load(io.BytesIO(_exactly(pipe, length)), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _exactly(pipe: IO[bytes], count: int) -> bytes:
    data = pipe.read(count)
    if len(data) < count:
        raise EOFError
    return data


def main() -> None:
    """Serve on standard input and output; what libraries print goes to standard error."""
    settings, niceness = sys.argv[1:]
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    lower_priority(int(niceness))
    with contextlib.suppress(BrokenPipeError):  # the caller is gone
        serve(RobustSolver(RobustSolverConfig(**json.loads(settings))), sys.stdin.buffer, answers)


if __name__ == '__main__':
    main()
