"""Every row of the README's diagnostics table that no other test raises, and what must be quiet."""

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip('rclpy')
import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from ekf_bench import DRIVE, QUIET, START_NS, Bench, camera, imu, odom, stamp
from geometry_msgs.msg import TwistWithCovarianceStamped
from std_srvs.srv import SetBool

from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_common.nodes import messages

pytestmark = pytest.mark.ros
Make = Callable[..., Any]
MakeBench = Callable[..., Bench]


@pytest.fixture
def bench(make: Make) -> MakeBench:
    def construct(**parameters: object) -> Bench:
        values = {**QUIET, 'publish_rate': 10.0, **parameters}
        return Bench(make(EkfNode, **values))

    return construct


def _imu_dies(running: Bench) -> None:
    running.drive(0, 101)
    running.lockstep.set_time(stamp(151))


def _imu_dies_at_the_start(running: Bench) -> None:
    running.drive(0, 1)
    running.lockstep.set_time(stamp(60))


def _imu_never_comes(running: Bench) -> None:
    running.lockstep.set_time(START_NS)
    assert 'silent' not in running.problems()[1]
    running.lockstep.set_time(START_NS + 600_000_000)


def _imu_is_not_mounted(running: Bench) -> None:
    running.lockstep.set_time(stamp(0))
    running.feed('imu', imu(0, header=messages.header(stamp(0), 'elsewhere')))


def _nothing_absolute(running: Bench) -> None:
    running.drive(0, 101)
    running.drive(101, 301, camera_every=0)
    assert 'no pose and no fix' not in running.problems()[1]
    running.drive(301, 701, camera_every=0)


def _it_gives_in(running: Bench) -> None:
    running.drive(0, 101)
    for k in range(101, 401):
        running.feed('imu', imu(k))
        if k % 10 == 0:
            running.feed('camera_pose', camera(k, off=[8.0, 0.0, 0.0]))
    assert running.node.diagnostics.counted('camera recoveries') == 1


_NEVER_UNSURE = {'health__position_warn': 0.0, 'health__position_error': 0.0}


@pytest.mark.parametrize(
    ('mishap', 'level', 'text'),
    [
        (_imu_is_not_mounted, DiagnosticStatus.ERROR, 'does not connect base_link with elsewhere'),
        (_imu_dies, DiagnosticStatus.ERROR, 'imu has been silent for'),
        (_imu_dies_at_the_start, DiagnosticStatus.ERROR, 'imu has been silent for'),
        (_imu_never_comes, DiagnosticStatus.ERROR, 'imu has been silent for 0.6 s'),
        (_nothing_absolute, DiagnosticStatus.ERROR, 'no pose and no fix was accepted for'),
        (_it_gives_in, DiagnosticStatus.WARN, 'gave in to rejected observations'),
    ],
)
def test_a_row_of_the_table_is_raised_and_cleared(
    bench: MakeBench, mishap: Callable[[Bench], None], level: bytes, text: str
) -> None:
    running = bench(**_NEVER_UNSURE, health__absolute_error=4.0)
    mishap(running)
    given, said = running.problems()
    assert given == level and text in said
    # All is well again: ten seconds on, from wherever the filter is by then.
    running.drive(1001, 2101)
    assert running.problems() == (DiagnosticStatus.OK, 'ok')


@pytest.mark.parametrize(
    ('name', 'timeout_s', 'parameters'),
    [
        ('front', 1.0, {'poses': 'camera front', 'front__topic': 'front/pose'}),
        ('wheels', 1.0, {'twists': 'wheels'}),
        ('odom', 1.0, {'odometry': 'odom'}),
        ('odom', 1.0, {'odometry': 'odom', 'odom__use': 'nothing', 'tf': 'map_to_odom'}),
        ('gps', 3.0, {'fixes': 'gps'}),
    ],
)
def test_an_input_that_never_came_is_a_warning(
    bench: MakeBench, name: str, timeout_s: float, parameters: dict[str, object]
) -> None:
    running = bench(**parameters)
    last = round(timeout_s * 100)
    running.drive(0, last + 1)
    assert running.problems() == (DiagnosticStatus.OK, 'ok')
    running.drive(last + 1, last + 102)
    level, text = running.problems()
    assert level == DiagnosticStatus.WARN
    assert text.startswith(f'{name} has been silent for') and 'nothing came' in text


def test_a_camera_that_never_came_is_said_beside_the_wait_for_it(bench: MakeBench) -> None:
    running = bench()
    running.drive(0, 301, camera_every=0)
    level, text = running.problems()
    assert level == DiagnosticStatus.WARN
    assert 'camera has been silent' in text and 'waiting for a full pose' in text


def test_a_camera_that_dies_right_at_the_start_is_a_warning(bench: MakeBench) -> None:
    running = bench(**_NEVER_UNSURE)
    running.drive(0, 1)  # its one pose starts the filter
    running.drive(1, 201, camera_every=0)
    level, text = running.problems()
    assert level == DiagnosticStatus.WARN and 'camera has been silent' in text


@pytest.mark.parametrize('parameters', [{'odom__use': 'nothing'}, {'odom__use': 'both'}])
def test_what_is_not_an_input_of_its_own_is_never_silent(
    bench: MakeBench, parameters: dict[str, object]
) -> None:
    running = bench(odometry='odom', odom__sigma_position=1.0, odom__sigma_rotation=0.1,
                    **parameters)  # fmt: skip
    for k in range(0, 301, 10):
        running.drive(k, k + 10)
        if parameters['odom__use'] == 'both':
            message = odom(k, np.eye(4), None)
            message.twist.covariance = (100.0 * np.eye(6)).ravel()
            running.feed('odom', message)
    assert 'silent' not in running.problems()[1]


def test_while_it_is_disabled_nothing_is_silent(bench: MakeBench) -> None:
    running = bench(enabled=False)
    running.drive(0, 301)
    assert running.problems()[1] == (
        'disabled: ~/enable switches it on; '
        'waiting for imu and for its place on /tf_static (or set use_imu to false)'
    )
    running.node.on_enable(SetBool.Request(data=True), SetBool.Response())
    assert 'silent' not in running.problems()[1]
    running.lockstep.set_time(stamp(400))
    assert 'imu has been silent' in running.problems()[1]


def test_a_clock_that_jumps_back_makes_nothing_silent_and_hides_nothing(bench: MakeBench) -> None:
    running = bench()
    running.drive(1000, 1101)
    running.problems()
    running.lockstep.set_time(stamp(0))  # a bag that begins anew, without its sensors
    assert 'silent' not in running.problems()[1]
    running.lockstep.set_time(stamp(200))
    text = running.problems()[1]
    assert 'imu has been silent' in text and 'camera has been silent' in text


@pytest.mark.parametrize('rate_hz', [100, 400])
def test_the_noise_of_a_turn_rate_is_that_of_a_sample_at_the_imus_own_rate(
    bench: MakeBench, rate_hz: int
) -> None:
    """White noise of density n has the variance n^2 rate; a wheel's twist is judged by it too."""
    noise, own = 0.01, 1e-8
    running = bench(
        motion__gyroscope_noise=noise, twists='wheels', wheels__axes='yaw', publish_rate=0.0,
        start__gyroscope_bias=1e-5, motion__gyroscope_walk=0.0, gate__probability=1.0,
    )  # fmt: skip
    for k in range(100):
        message = imu(k)
        message.header.stamp = messages.header(START_NS + k * 1_000_000_000 // rate_hz, '').stamp
        running.feed('imu', message)
        if k == 0:
            running.feed('camera_pose', camera(0))
    given = np.array(running.odometry[-1].twist.covariance).reshape(6, 6)[3:, 3:]
    np.testing.assert_allclose(given, noise**2 * rate_hz * np.eye(3), atol=1e-6)
    now_ns = START_NS + 99 * 1_000_000_000 // rate_hz
    seen = TwistWithCovarianceStamped(header=messages.header(now_ns, 'imu'))
    off = 0.3
    seen.twist.twist.angular.z = DRIVE.turn_rates[99][2] + off
    seen.twist.covariance[35] = own
    running.feed('twist', seen)
    nis = [v.value for v in running.node.diagnostics.status().values if v.key == 'wheels NIS']
    assert float(nis[0]) == pytest.approx(off**2 / (noise**2 * rate_hz), rel=0.02)
