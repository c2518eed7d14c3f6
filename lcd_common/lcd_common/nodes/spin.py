"""Run nodes: one per process as a console script, or several composed in one process."""

import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from lcd_common.errors import LocalizationError
from lcd_common.nodes.large_messages import carry_large_messages


def spin(*nodes: Node) -> None:
    """Spin nodes on one executor until Ctrl-C or shutdown, then destroy them."""
    executor = SingleThreadedExecutor()
    try:
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.shutdown()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def run_node(make: Callable[[], Node], help_text: str, argv: list[str] | None = None) -> int:
    """Run one node as a console script; `--help` prints its documentation.

    A wrong argument, or a LocalizationError while it is constructed (a wrong parameter), is one
    line and status 1.
    """
    arguments = sys.argv[1:] if argv is None else argv
    if '-h' in arguments or '--help' in arguments:
        sys.stdout.write(help_text.rstrip() + '\n')
        return 0
    carry_large_messages()
    try:
        rclpy.init(args=[sys.argv[0], *arguments])
    except RuntimeError as error:  # rcl's own: a parameter file that cannot be read, a bad remap
        sys.stderr.write(f'error: {str(error).splitlines()[0]}\n')
        return 1
    try:
        node = make()
    except LocalizationError as error:
        sys.stderr.write(f'error: {error}\n')
        rclpy.try_shutdown()
        return 1
    spin(node)
    return 0
