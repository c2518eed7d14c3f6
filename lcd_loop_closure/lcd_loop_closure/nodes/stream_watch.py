"""Watch the stamps of a stream in a node, and act when the clock jumps back."""

from collections.abc import Callable

from rclpy.node import Node

from lcd_common.nodes.diagnostics import Diagnostics
from lcd_common.stamps import StampGuard, StampVerdict


class StreamWatch:
    """Let new stamps through; count repeated and late ones; restart or refuse after a jump back.

    A looped bag and a restarted simulation look alike: the stamps fall by more than a second.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: Diagnostics,
        stream: str,
        policy: str,
        restart: Callable[[int], None],
    ) -> None:
        """Watch a stream.

        Args:
            node: for its log.
            diagnostics: counts what is not let through.
            stream: name of the topic, for people.
            policy: `restart` or `refuse`.
            restart: called with the new stamp after a jump back under the policy `restart`.
        """
        self._log, self._diagnostics = node.get_logger(), diagnostics
        self._stream, self._policy, self._restart = stream, policy, restart
        self._guard = StampGuard()
        self._refusing = False

    def takes(self, stamp_ns: int) -> bool:
        """Tell whether a message should be used."""
        if self._refusing:
            self._diagnostics.count(f'rejected {self._stream}: clock jumped back')
            return False
        verdict = self._guard.check(stamp_ns)
        if verdict is StampVerdict.NEW:
            return True
        if verdict is not StampVerdict.JUMPED_BACK:
            self._diagnostics.count(f'rejected {self._stream}: {verdict.value} stamp')
            return False
        newest = self._guard.newest_ns or 0
        text = (
            f'the stamps of {self._stream} jumped back by {(newest - stamp_ns) * 1e-9:.1f} s '
            '(a looped bag, a restarted simulation)'
        )
        self._diagnostics.count(f'clock jumps in {self._stream}')
        if self._policy == 'refuse':
            self._refusing = True
            text += ': refusing input until ~/reset is called (on_time_jump: refuse)'
            self._log.error(text)
            self._diagnostics.error(f'clock {self._stream}', text)
            return False
        self._log.warning(text + ': starting again (on_time_jump: restart)')
        self._restart(stamp_ns)
        self.reset()
        return self._guard.check(stamp_ns) is StampVerdict.NEW

    def reset(self) -> None:
        """Forget the stamps and take input again."""
        self._guard.reset()
        self._refusing = False
        self._diagnostics.error(f'clock {self._stream}', None)
