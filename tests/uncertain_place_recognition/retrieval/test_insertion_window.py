import numpy as np

from uncertain_place_recognition.retrieval.insertion_window import (
    Entry,
    InsertionConfig,
    InsertionWindow,
)


def entry(number, stamp_ns):
    return Entry(number, np.zeros(2, np.float32), stamp_ns)


def ids(entries):
    return [one.place_id for one in entries]


def test_entries_of_an_earlier_drive_do_not_wait():
    window = InsertionWindow(InsertionConfig(seconds=5.0, entries=3))
    assert ids(window.push(entry(1, None))) == [1]
    assert len(window) == 0


def test_time_and_number_must_both_be_over():
    window = InsertionWindow(InsertionConfig(seconds=1.0, entries=2))
    assert not window.push(entry(0, 0))
    assert not window.push(entry(1, 400_000_000))
    assert not window.push(entry(2, 800_000_000)), 'two came after, but a second is not over'
    assert ids(window.release(1_000_000_000)) == [0]
    assert not window.release(9_000_000_000), 'time is over, but two must come after'
    assert ids(window.push(entry(3, 9_100_000_000))) == [1]


def test_stamps_of_today_are_told_apart_to_the_nanosecond():
    now = 1_760_000_000_123_456_789
    window = InsertionWindow(InsertionConfig(seconds=1.0))
    window.push(entry(0, now))
    assert not window.release(now + 999_999_999)
    assert ids(window.release(now + 1_000_000_000)) == [0]


def test_a_stamp_out_of_order_does_not_turn_time_back():
    window = InsertionWindow(InsertionConfig(seconds=1.0))
    window.push(entry(0, 10_000_000_000))
    assert not window.push(entry(1, 0))
    assert ids(window.push(entry(2, 11_000_000_000))) == [0, 1]


def test_without_a_delay_nothing_waits():
    window = InsertionWindow()
    assert ids(window.push(entry(4, 123))) == [4]
