"""Take single keys from the terminal without blocking."""

import os
import select
import sys
import termios
import time
import tty
from types import TracebackType
from typing import Any, Self


class Keyboard:
    """Read keys while the block runs; without a terminal there are none."""

    def __init__(self, enabled: bool) -> None:
        self._saved: list[Any] | None = None
        self._enabled = enabled and sys.stdin.isatty()

    def __enter__(self) -> Self:
        """Take each key at once, without Enter; Ctrl-C still works."""
        if self._enabled:
            self._saved = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the terminal back as it was."""
        if self._saved is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._saved)

    @property
    def enabled(self) -> bool:
        """True when there is a terminal."""
        return self._enabled

    def wait(self, seconds: float) -> str:
        """Sleep, and return a key that was hit meanwhile (then at once), or an empty string."""
        if not self._enabled:
            time.sleep(max(0.0, seconds))
            return ''
        ready, _, _ = select.select([sys.stdin], [], [], max(0.0, seconds))
        # Not through the text stream: what it buffers, select no longer sees.
        return os.read(sys.stdin.fileno(), 1).decode(errors='replace') if ready else ''
