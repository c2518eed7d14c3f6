"""Keys come one by one from a terminal, which is given back as it was."""

import os
import pty
import sys
import termios
from collections.abc import Iterator

import pytest

from bags.nodes.keyboard import Keyboard

pytestmark = pytest.mark.ros


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, 'r') as stdin:
        monkeypatch.setattr(sys, 'stdin', stdin)
        yield ours
    os.close(ours)


def test_keys_arrive_without_enter(terminal: int) -> None:
    before = termios.tcgetattr(sys.stdin)
    with Keyboard(True) as keyboard:
        assert keyboard.enabled
        os.write(terminal, b' ')
        assert keyboard.wait(5.0) == ' '
        assert keyboard.wait(0.0) == ''
        os.write(terminal, b'sq')  # typed faster than they are taken
        assert [keyboard.wait(5.0), keyboard.wait(5.0)] == ['s', 'q']
    assert termios.tcgetattr(sys.stdin) == before


def test_without_a_terminal_there_are_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as stdin:
        monkeypatch.setattr(sys, 'stdin', stdin)
        with Keyboard(True) as keyboard:
            assert not keyboard.enabled
            assert keyboard.wait(0.0) == ''


def test_keys_can_be_switched_off(terminal: int) -> None:
    with Keyboard(False) as keyboard:
        os.write(terminal, b'q')
        assert keyboard.wait(0.0) == ''
