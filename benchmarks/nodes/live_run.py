"""Play a bag at 1x through DDS to separately started node processes, and watch."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.nodes.live_recorder import LiveRecorder
from lcd_common.errors import LocalizationError

Processes = dict[str, 'subprocess.Popen[bytes]']
NODES = ('lidar_odometry', 'loop_closure', 'pose_graph')
_QUIET_S = 5.0
_START_S = 60.0


class LiveRunError(LocalizationError):
    """The live run did not start or did not end."""


@dataclass(frozen=True)
class LiveResult:
    """What a live run left: the recorder with all it saw, and each node's peak memory in bytes."""

    recorder: LiveRecorder
    peak_memory_bytes: dict[str, int]


def run_live(
    bag: Path, parameters: Mapping[str, Sequence[str]], log: Path, max_settle_s: float = 120.0
) -> LiveResult:
    """Run the three nodes on a bag.

    Args:
        bag: rosbag2 folder or mcap.
        parameters: node -> `name:=value` strings, e.g. {'lidar_odometry': ['min_range:=3.0']}.
        log: folder for what the processes print.
        max_settle_s: how long the nodes may still work after the last message.

    Raises:
        LiveRunError: a process ended by itself or the player failed.
    """
    log.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', '77')
    # This process only listens; its environment's discovery settings are the children's too.
    rclpy.init()
    recorder = LiveRecorder()
    executor = SingleThreadedExecutor()
    executor.add_node(recorder)
    processes = {name: _start(name, parameters.get(name, ()), log) for name in NODES}
    try:
        _await_nodes(recorder, executor, processes)
        player = _start_player(bag, log)
        _spin_while(executor, lambda: player.poll() is None, processes)
        if player.returncode != 0:
            raise LiveRunError(f'bags play failed; see {log / "play.log"}')
        _settle(recorder, executor, processes, max_settle_s)
        memory = {name: _peak_memory(process.pid) for name, process in processes.items()}
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        for process in processes.values():
            try:
                process.wait(timeout=20.0)
            except subprocess.TimeoutExpired:
                process.kill()
        executor.shutdown()
    recorder.destroy_node()
    rclpy.try_shutdown()
    return LiveResult(recorder, memory)


def _start(name: str, parameters: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    executable = Path(sys.executable).parent / name
    arguments = [str(executable), '--ros-args']
    reliable = [] if name == 'pose_graph' else ['reliable_points:=true']
    for parameter in (*reliable, *parameters):
        arguments += ['-p', parameter]
    file = (log / f'{name}.log').open('wb')
    return subprocess.Popen(arguments, stdout=file, stderr=subprocess.STDOUT)


def _start_player(bag: Path, log: Path) -> subprocess.Popen[bytes]:
    command = [str(Path(sys.executable).parent / 'bags'), 'play', str(bag), '--wait-for', '3']
    file = (log / 'play.log').open('wb')
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
    )


def _await_nodes(
    recorder: LiveRecorder, executor: SingleThreadedExecutor, processes: Processes
) -> None:
    deadline = time.monotonic() + _START_S
    while not set(NODES) <= set(recorder.get_node_names()):
        _check(processes)
        if time.monotonic() > deadline:
            raise LiveRunError(f'the nodes did not start within {_START_S:.0f} s')
        executor.spin_once(timeout_sec=0.1)


def _spin_while(
    executor: SingleThreadedExecutor, condition: Callable[[], bool], processes: Processes
) -> None:
    while condition():
        executor.spin_once(timeout_sec=0.1)
        _check(processes)


def _settle(
    recorder: LiveRecorder,
    executor: SingleThreadedExecutor,
    processes: Processes,
    max_settle_s: float,
) -> None:
    """Wait until no result has come for a while: loop closure works behind the scans."""
    deadline = time.monotonic() + max_settle_s
    seen, since = -1, time.monotonic()
    while time.monotonic() < deadline and time.monotonic() - since < _QUIET_S:
        executor.spin_once(timeout_sec=0.1)
        _check(processes)
        now = len(recorder.odometry_published_ns) + len(recorder.candidates)
        if now != seen:
            seen, since = now, time.monotonic()


def _check(processes: Processes) -> None:
    for name, process in processes.items():
        if process.poll() is not None:
            raise LiveRunError(f'{name} ended with status {process.returncode}; see its log')


def _peak_memory(pid: int) -> int:
    status = Path(f'/proc/{pid}/status').read_text()
    line = next(line for line in status.splitlines() if line.startswith('VmHWM:'))
    return int(line.split()[1]) * 1024
