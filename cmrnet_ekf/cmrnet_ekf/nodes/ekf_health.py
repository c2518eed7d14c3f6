"""Judge the EKF's health: which inputs are silent or refused, and how sure the pose is."""

from dataclasses import dataclass

from rclpy.node import Node

from cmrnet_ekf.ekf.update import Verdict
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from cmrnet_ekf.nodes.ekf_outputs import largest_position_sigma
from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.settings import config, setting


@config
class EkfHealthConfig:
    """When diagnostics warn."""

    position_warn: float = setting(
        1.0, 'WARN when the position is less sure than this (sigma); 0: never', unit='m', low=0.0
    )
    position_error: float = setting(
        5.0, 'ERROR when the position is less sure than this (sigma); 0: never', unit='m', low=0.0
    )
    absolute_error: float = setting(
        30.0, 'ERROR when no pose and no fix was accepted for this long', unit='s', low=0.1
    )
    rejected_warn: int = setting(5, 'WARN when an input was rejected so many times in a row', low=1)
    imu_timeout: float = setting(0.5, 'ERROR when imu is silent for longer', unit='s', low=0.01)


@dataclass
class _Input:
    timeout_s: float
    absolute: bool
    came_ns: int | None = None  # by the node's clock
    rejected: int = 0
    nis: float = 0.0


class EkfHealth:
    """Hear of everything that comes, and keep the diagnostics true."""

    def __init__(self, node: Node, diagnostics: Diagnostics, settings: EkfHealthConfig) -> None:
        self.settings = settings
        self._node, self._diagnostics = node, diagnostics
        self._inputs: dict[str, _Input] = {}
        # From when silence counts where nothing came; by the node's clock, as all times here.
        self._begun_ns = self._absolute_ns = self._now_ns()
        self._checked_ns = 0
        self._recovered_ns: int | None = None

    def add(self, name: str, timeout_s: float, *, absolute: bool = False) -> None:
        """Watch an input; with an infinite timeout it may be silent."""
        self._inputs[name] = _Input(timeout_s, absolute)
        if name == 'imu':  # it moves the estimate and is not judged by it
            return
        self._diagnostics.watch(f'{name} rejected in a row', lambda: self._inputs[name].rejected)
        self._diagnostics.watch(f'{name} NIS', lambda: f'{self._inputs[name].nis:.2f}')

    def came(self, name: str, stamp_ns: int) -> None:
        """Note a message."""
        self._inputs[name].came_ns = self._now_ns()
        self._diagnostics.tick(name, stamp_ns)

    def is_silent(self, name: str) -> bool:
        """Tell whether an input has not come for longer than its timeout, or never."""
        seen = self._inputs[name]
        return seen.came_ns is None or self._seconds_since(seen.came_ns) > seen.timeout_s

    def judged(self, verdict: Verdict) -> None:
        """Note what became of an observation."""
        if verdict.dof == 0:
            return
        seen = self._inputs[verdict.source]
        seen.nis = verdict.nis
        self._diagnostics.count(
            f'{verdict.source} {"accepted" if verdict.accepted else "rejected: outlier"}'
        )
        seen.rejected = 0 if verdict.accepted else seen.rejected + 1
        if verdict.recovered:
            self._recovered_ns = self._now_ns()
            self._diagnostics.count(f'{verdict.source} recoveries')
            self._node.get_logger().warning(
                f'{verdict.source} was rejected again and again, always alike: the filter was '
                'wrong and starts from it'
            )
        if verdict.accepted and seen.absolute:
            self._absolute_ns = self._now_ns()

    def restarted(self) -> None:
        """Forget what was before a start."""
        for seen in self._inputs.values():
            seen.rejected = 0
        self._count_from(self._now_ns())

    def check(self, ekf: VehicleEkf | None, *, enabled: bool, waits_for: str | None) -> None:
        """Raise and clear problems; called once a second."""
        problem = self._diagnostics
        self._mind_the_clock()
        problem.warn('enabled', None if enabled else 'disabled: ~/enable switches it on')
        problem.warn('start', waits_for)
        for name, seen in self._inputs.items():
            self._check_input(name, seen, enabled)
        recent = self._recovered_ns is not None and self._seconds_since(self._recovered_ns) < 10.0
        problem.warn('recovered', 'gave in to rejected observations' if recent else None)
        estimate = None if ekf is None else ekf.estimate()
        unsure = None
        absolute = any(seen.absolute for seen in self._inputs.values())
        if absolute and estimate is not None:
            silent = self._seconds_since(self._absolute_ns)
            if silent > self.settings.absolute_error:
                unsure = f'no pose and no fix was accepted for {silent:.0f} s'
        problem.error('absolute', unsure)
        sigma = 0.0 if estimate is None else largest_position_sigma(estimate)
        text = f'the position is only known to {sigma:.2f} m (sigma)'
        bad = 0.0 < self.settings.position_error < sigma
        poor = not bad and 0.0 < self.settings.position_warn < sigma
        problem.error('position is bad', text if bad else None)
        problem.warn('position is poor', text if poor else None)

    def _check_input(self, name: str, seen: _Input, enabled: bool) -> None:
        came_ns = self._begun_ns if seen.came_ns is None else seen.came_ns
        silent, text = self._seconds_since(came_ns), None
        if enabled and silent > seen.timeout_s:
            text = f'{name} has been silent for {silent:.1f} s'
            if seen.came_ns is None:
                text += ': nothing came since the start'
        raised = self._diagnostics.error if name == 'imu' else self._diagnostics.warn
        raised(f'silent {name}', text)
        refused = None
        if seen.rejected >= self.settings.rejected_warn:
            refused = f'{name} was rejected {seen.rejected} times in a row: wrong, or too sure'
        self._diagnostics.warn(f'refused {name}', refused)

    def _mind_the_clock(self) -> None:
        """Count anew when the clock jumped back, or begins (a simulated one stands at 0 before)."""
        now_ns = self._now_ns()
        if now_ns < max(self._begun_ns, self._checked_ns) or self._begun_ns == 0:
            self._count_from(now_ns)
        self._checked_ns = now_ns

    def _count_from(self, now_ns: int) -> None:
        self._begun_ns = self._absolute_ns = now_ns
        self._recovered_ns = None
        for seen in self._inputs.values():
            seen.came_ns = None

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _seconds_since(self, then_ns: int) -> float:
        return (self._now_ns() - then_ns) * 1e-9
