"""Do what a service is asked beside the callbacks, and answer when it is done."""

import threading
from collections.abc import Callable

from rclpy.node import Node
from rclpy.task import Future

from lcd_common.errors import LocalizationError


class Awaited:
    """Run the long part of a service callback on a thread of its own; `await` its answer.

    The service needs a callback group of its own, so that others go on while it is awaited.
    """

    def __init__(self, node: Node, *, threaded: bool) -> None:
        """Prepare; `threaded` False works inside the callback, as lock-step replay needs it."""
        self._threaded = threaded
        self._wake = node.create_guard_condition(lambda: None, callback_group=None)

    async def answer(self, work: Callable[[], str], what: str) -> tuple[bool, str]:
        """Return success and the message of a service's response.

        Args:
            work: returns the message, or raises.
            what: is said before an error that nobody foresaw.
        """
        if not self._threaded:
            return _done(work, what)
        written: Future = Future()

        def run() -> None:
            written.set_result(_done(work, what))
            self._wake.trigger()  # the executor may be asleep

        threading.Thread(target=run).start()
        answer: tuple[bool, str] = await written
        return answer


def _done(work: Callable[[], str], what: str) -> tuple[bool, str]:
    try:
        return True, work()
    except LocalizationError as error:
        return False, str(error)
    except Exception as error:  # noqa: BLE001 - a service that never answers is worse
        return False, f'{what}: {error!r}'
