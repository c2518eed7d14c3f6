"""The play clock, on a clock that the test moves."""

import math

from bags.play_clock import PlayClock

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND


class Wall:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_stamps_are_due_by_the_rate() -> None:
    wall = Wall()
    clock = PlayClock(2.0, wall)
    clock.start(BEGIN)
    assert clock.wait_s(BEGIN + 4 * SECOND) == 2.0
    wall.now_s += 1.5
    assert clock.now_ns() == BEGIN + 3 * SECOND
    assert clock.wait_s(BEGIN + 4 * SECOND) == 0.5
    wall.now_s += 1.0
    assert clock.wait_s(BEGIN + 4 * SECOND) == -0.5


def test_lateness_does_not_add_up() -> None:
    wall = Wall()
    clock = PlayClock(1.0, wall)
    clock.start(BEGIN)
    for number in range(1, 100):
        wall.now_s += max(0.0, clock.wait_s(BEGIN + number * SECOND)) + 0.25  # oversleeps each time
    assert wall.now_s == 100.0 + 99 + 0.25


def test_time_stands_while_paused() -> None:
    wall = Wall()
    clock = PlayClock(1.0, wall)
    assert clock.paused
    clock.start(BEGIN)
    wall.now_s += 1.0
    clock.pause()
    wall.now_s += 50.0
    assert clock.paused and clock.now_ns() == BEGIN + SECOND
    assert math.isinf(clock.wait_s(BEGIN + 2 * SECOND))
    clock.resume()
    assert clock.wait_s(BEGIN + 2 * SECOND) == 1.0
    clock.resume()  # changes nothing
    assert clock.wait_s(BEGIN + 2 * SECOND) == 1.0


def test_steps_move_a_paused_clock_alone() -> None:
    wall = Wall()
    clock = PlayClock(1.0, wall)
    clock.start(BEGIN)
    clock.step_to(BEGIN + 9 * SECOND)
    assert clock.now_ns() == BEGIN
    clock.pause()
    clock.step_to(BEGIN + 9 * SECOND)
    clock.step_to(BEGIN)  # never back
    assert clock.now_ns() == BEGIN + 9 * SECOND


def test_it_jumps() -> None:
    wall = Wall()
    clock = PlayClock(1.0, wall)
    clock.start(BEGIN)
    wall.now_s += 7.0
    clock.start(BEGIN)
    assert clock.now_ns() == BEGIN
