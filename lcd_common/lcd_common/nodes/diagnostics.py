"""Publish what an operator acts on: rates, queues, drops, rejected inputs by cause, stage times."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from lcd_common.nodes import qos

_WINDOW = 200


class Diagnostics:
    """Collect a node's health and publish it on /diagnostics once a second (node clock).

    Safe to call from worker threads. Rates come from header stamps, so a paused or slow bag does
    not look like a broken sensor.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._stages: dict[str, deque[float]] = {}
        self._stamps: dict[str, deque[int]] = {}
        self._values: dict[str, Callable[[], object]] = {}
        self._problems: dict[str, tuple[bytes, str]] = {}
        self.on_time: Callable[[str, float], None] | None = None  # hears every stage
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', qos.RELIABLE)
        node.create_timer(1.0, self.publish)

    def count(self, cause: str, amount: int = 1) -> None:
        """Add to a counter, e.g. `rejected: no transform`."""
        with self._lock:
            self._counts[cause] += amount

    def counted(self, cause: str) -> int:
        """Return a counter's value."""
        with self._lock:
            return self._counts[cause]

    def tick(self, stream: str, stamp_ns: int) -> None:
        """Note a message of a stream; its rate is computed from the header stamps."""
        with self._lock:
            self._stamps.setdefault(stream, deque(maxlen=50)).append(stamp_ns)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage of the work."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.time(name, time.perf_counter() - start)

    def time(self, name: str, seconds: float) -> None:
        """Note how long a stage took."""
        with self._lock:
            self._stages.setdefault(name, deque(maxlen=_WINDOW)).append(seconds)
        if self.on_time is not None:
            self.on_time(name, seconds)

    def watch(self, name: str, value: Callable[[], object]) -> None:
        """Report `value()` at every publication, e.g. a queue's length."""
        self._values[name] = value

    def warn(self, problem: str, text: str | None) -> None:
        """Raise (or clear, with None) a problem that an operator should look at."""
        self._set(problem, DiagnosticStatus.WARN, text)

    def error(self, problem: str, text: str | None) -> None:
        """Raise (or clear, with None) a problem that makes the node's output unusable."""
        self._set(problem, DiagnosticStatus.ERROR, text)

    def _set(self, problem: str, level: bytes, text: str | None) -> None:
        with self._lock:
            if text is None:
                self._problems.pop(problem, None)
            else:
                self._problems[problem] = (level, text)

    def counts(self) -> dict[str, int]:
        """Return every counter by its cause."""
        with self._lock:
            return dict(self._counts)

    def stage_times_ms(self) -> dict[str, list[float]]:
        """Return the recent times of every stage, milliseconds."""
        with self._lock:
            return {name: [1e3 * t for t in times] for name, times in self._stages.items()}

    def status(self) -> DiagnosticStatus:
        """Return the state as one DiagnosticStatus."""
        with self._lock:
            problems = list(self._problems.values())
            rows = [(name, str(count)) for name, count in sorted(self._counts.items())]
            for stream, stamps in self._stamps.items():
                span = (stamps[-1] - stamps[0]) * 1e-9
                if span > 0:
                    rows.append((f'{stream} rate [Hz]', f'{(len(stamps) - 1) / span:.2f}'))
            for name, times in self._stages.items():
                p50, p99 = np.percentile(times, [50, 99]) * 1e3
                # One number a row: plotting panels read them, pairs of numbers they do not.
                rows.append((f'{name} median [ms]', f'{p50:.1f}'))
                rows.append((f'{name} p99 [ms]', f'{p99:.1f}'))
        rows += [(name, str(value())) for name, value in self._values.items()]
        return DiagnosticStatus(
            level=max((level for level, _ in problems), default=DiagnosticStatus.OK),
            name=self._node.get_fully_qualified_name(),
            message='; '.join(text for _, text in problems) or 'ok',
            hardware_id='none',
            values=[KeyValue(key=key, value=value) for key, value in rows],
        )

    def publish(self) -> None:
        """Publish the state now."""
        message = DiagnosticArray(status=[self.status()])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
