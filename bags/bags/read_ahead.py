"""Read ahead on a thread, so that a slow chunk of a file does not delay what is due now."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

Item = TypeVar('Item')


class ReadAhead(Generic[Item]):
    """Iterate over another iterator that runs ahead by items of at most `capacity` in all.

    What the other raises is raised here, in its place.
    """

    def __init__(
        self, items: Iterator[Item], capacity: float, size_of: Callable[[Item], float]
    ) -> None:
        """Start reading.

        Args:
            items: what to read; used on the thread alone.
            capacity: of what waits, in the unit of `size_of`; one item may always wait.
            size_of: tells how much of the capacity an item takes.
        """
        self._items, self._capacity, self._size_of = items, capacity, size_of
        self._waiting: deque[Item] = deque()
        self._size = 0.0
        self._error: BaseException | None = None
        self._ended = self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='read ahead', daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[Item]:
        """Yield the items in order."""
        while True:
            with self._changed:
                while not self._waiting and not self._ended:
                    self._changed.wait()
                if not self._waiting:
                    if self._error is not None:
                        raise self._error
                    return
                item = self._waiting.popleft()
                self._size -= self._size_of(item)
                self._changed.notify_all()
            yield item

    def stop(self) -> None:
        """End the thread after the item it reads; what waits is forgotten."""
        with self._changed:
            self._stopped = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(timeout=10.0)

    def wait_until_full(self) -> None:
        """Wait until it has read as far ahead as it may, or to the end."""
        with self._changed:
            while not self._ended and self._size < self._capacity:
                self._changed.wait()

    def _run(self) -> None:
        try:
            for item in self._items:
                with self._changed:
                    while self._size >= self._capacity and not self._stopped:
                        self._changed.wait()
                    if self._stopped:
                        return
                    self._waiting.append(item)
                    self._size += self._size_of(item)
                    self._changed.notify_all()
        except BaseException as error:  # noqa: BLE001 - handed to whoever iterates
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()
