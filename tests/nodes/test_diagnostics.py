"""Diagnostics say what an operator acts on, from stamps and not from the wall clock."""

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node

from lcd_common.nodes.diagnostics import Diagnostics

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('ros')]


@pytest.fixture
def node():
    node = Node('health', namespace='robot')
    yield node
    node.destroy_node()


def test_counts_rates_stages_and_levels(node: Node) -> None:
    diagnostics = Diagnostics(node)
    diagnostics.count('rejected: NaN points', 3)
    diagnostics.count('rejected: NaN points')
    for k in range(11):
        diagnostics.tick('points', k * 200_000_000)
    for milliseconds in range(1, 101):
        diagnostics.time('registration', milliseconds * 1e-3)
    diagnostics.watch('queue length', lambda: 7)
    status = diagnostics.status()
    values = {pair.key: pair.value for pair in status.values}
    assert status.name == '/robot/health'
    assert values['rejected: NaN points'] == '4'
    assert values['points rate [Hz]'] == '5.00'
    assert values['registration median [ms]'] == '50.5'
    assert values['registration p99 [ms]'] == '99.0'
    assert values['queue length'] == '7'
    assert status.level == DiagnosticStatus.OK and status.message == 'ok'
    assert diagnostics.counted('rejected: NaN points') == 4

    diagnostics.warn('slow', 'queue is full')
    assert diagnostics.status().level == DiagnosticStatus.WARN
    diagnostics.error('tf', 'two authorities')
    assert diagnostics.status().level == DiagnosticStatus.ERROR
    assert 'queue is full' in diagnostics.status().message
    diagnostics.error('tf', None)
    diagnostics.warn('slow', None)
    assert diagnostics.status().message == 'ok'


def test_stage_times_even_what_fails(node: Node) -> None:
    diagnostics = Diagnostics(node)
    with pytest.raises(ZeroDivisionError), diagnostics.stage('work'):
        raise ZeroDivisionError
    assert len(diagnostics.stage_times_ms()['work']) == 1
