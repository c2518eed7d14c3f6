"""Do long work off the callback: one thread, a bounded queue, the oldest dropped and counted."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar('Item')


class Worker(Generic[Item]):
    """Hand items to `work` in order, on a thread of its own or (`threaded=False`) right away.

    Without a thread `put` returns when the work is done: that is what lock-step replay needs to
    give the same answer on every run.
    """

    def __init__(
        self,
        work: Callable[[Item], None],
        *,
        capacity: int,
        threaded: bool,
        on_drop: Callable[[Item], None],
        on_error: Callable[[Exception], None],
        name: str,
    ) -> None:
        """Start the worker.

        Args:
            work: called with each item.
            capacity: how many items may wait; when full, the oldest is dropped.
            threaded: False works inside `put`.
            on_drop: called with each dropped item, on the thread that puts.
            on_error: called when `work` raises; the worker goes on with the next item.
            name: of the thread, for people who look at it.
        """
        self._work, self._on_drop, self._on_error = work, on_drop, on_error
        self._items: deque[Item] = deque()
        self._capacity = capacity
        self._condition = threading.Condition()
        self._running = threaded
        self._busy = False
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name=name, daemon=True)
            self._thread.start()

    def put(self, item: Item) -> None:
        """Queue an item (threaded) or work on it (not threaded)."""
        if self._thread is None:
            self._do(item)
            return
        dropped = None
        with self._condition:
            if len(self._items) >= self._capacity:
                dropped = self._items.popleft()
            self._items.append(item)
            self._condition.notify()
        if dropped is not None:
            self._on_drop(dropped)

    def waiting(self) -> int:
        """Return how many items wait."""
        return len(self._items)

    def idle(self) -> bool:
        """Tell whether nothing waits and nothing is being worked on."""
        with self._condition:
            return not self._items and not self._busy

    def clear(self) -> None:
        """Forget the waiting items (after a clock jump, a reset)."""
        with self._condition:
            self._items.clear()

    def stop(self) -> None:
        """End the thread after its current item; waiting items are forgotten."""
        with self._condition:
            self._running = False
            self._items.clear()
            self._condition.notify()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while True:
            with self._condition:
                while self._running and not self._items:
                    self._condition.wait()
                if not self._running:
                    return
                item = self._items.popleft()
                self._busy = True
            try:
                self._do(item)
            finally:
                with self._condition:
                    self._busy = False

    def _do(self, item: Item) -> None:
        try:
            self._work(item)
        except Exception as error:  # noqa: BLE001 one bad item must not stop the node
            self._on_error(error)
