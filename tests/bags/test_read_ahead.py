"""Reading ahead keeps order, bounds and errors."""

import threading
from collections.abc import Iterator

import pytest

from bags.read_ahead import ReadAhead


def test_items_come_in_order() -> None:
    assert list(ReadAhead(iter(range(1000)), 10, lambda _: 1)) == list(range(1000))


def test_it_reads_no_further_than_its_capacity() -> None:
    read: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(100):
            read.append(number)
            yield number

    ahead = ReadAhead(numbers(), 50, lambda _: 10)
    ahead.wait_until_full()
    ahead.stop()
    assert len(read) in (5, 6)  # five wait, one may be in hand


def test_one_item_larger_than_all_the_room_passes() -> None:
    assert list(ReadAhead(iter([1, 2, 3]), 1.0, lambda _: 100.0)) == [1, 2, 3]


def test_an_error_comes_after_what_was_read() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise OSError('cut off')

    got: list[int] = []

    def take() -> None:
        got.extend(iter(ReadAhead(broken(), 10, lambda _: 1)))

    items = iter(ReadAhead(broken(), 10, lambda _: 1))
    assert next(items) == 1
    with pytest.raises(OSError, match='cut off'):
        next(items)
    with pytest.raises(OSError, match='cut off'):
        take()


def test_stopping_ends_the_thread() -> None:
    before = threading.active_count()
    ahead = ReadAhead(iter(range(10**9)), 10, lambda _: 1)
    assert next(iter(ahead)) == 0
    ahead.stop()
    assert threading.active_count() == before


def test_waiting_for_a_short_source_ends() -> None:
    ahead = ReadAhead(iter([1]), 10, lambda _: 1)
    ahead.wait_until_full()
    assert list(ahead) == [1]
