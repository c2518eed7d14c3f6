"""Answers of long services: what was written, a known error, an unknown one; on a thread or not."""

import threading
from collections.abc import Callable
from typing import Any

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from lcd_common.errors import MapError
from lcd_common.nodes.awaited import Awaited

pytestmark = pytest.mark.ros


class Plain(Node):
    def __init__(self, **options: Any) -> None:
        super().__init__('plain', **options)


def answered(node: Node, threaded: bool, work: Callable[[], str]) -> tuple[bool, str]:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    task = executor.create_task(Awaited(node, threaded=threaded).answer(work, 'it failed'))
    executor.spin_until_future_complete(task, timeout_sec=20.0)
    executor.remove_node(node)
    executor.shutdown()
    assert task.done()
    result: tuple[bool, str] = task.result()
    return result


@pytest.mark.parametrize('threaded', [True, False])
def test_the_work_is_done_on_a_thread_or_inside_and_its_message_comes_back(
    make: Callable[..., Any], threaded: bool
) -> None:
    on: list[threading.Thread] = []

    def work() -> str:
        on.append(threading.current_thread())
        return 'written'

    assert answered(make(Plain), threaded, work) == (True, 'written')
    assert (on[0] is threading.current_thread()) != threaded


@pytest.mark.parametrize('threaded', [True, False])
def test_errors_become_answers(make: Callable[..., Any], threaded: bool) -> None:
    def known() -> str:
        raise MapError('no space left')

    def unknown() -> str:
        raise RuntimeError('odd')

    node = make(Plain)
    assert answered(node, threaded, known) == (False, 'no space left')
    success, message = answered(node, threaded, unknown)
    assert not success and message == "it failed: RuntimeError('odd')"
