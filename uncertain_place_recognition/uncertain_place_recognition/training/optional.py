"""Do without what only shows how training goes: machines for training have little installed."""

import logging
from functools import cache
from typing import Any, Protocol

_log = logging.getLogger(__name__)


class Bar(Protocol):
    """What training asks of a progress bar."""

    def __enter__(self) -> 'Bar': ...

    def __exit__(self, *_: object) -> None: ...

    def update(self) -> Any:
        """Count a step."""

    def set_postfix_str(self, text: str, refresh: bool = True) -> Any:
        """Show a text behind the bar."""


class NoBar:
    """Shows nothing."""

    def __enter__(self) -> 'NoBar':
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def update(self) -> None:
        """Count nothing."""

    def set_postfix_str(self, text: str, refresh: bool = True) -> None:
        """Show nothing."""


def progress_bar(total: int, done: int, name: str, quiet: bool) -> Bar:
    """Return a bar over steps; one that shows nothing where tqdm is not installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return NoBar()
    bar: Bar = tqdm(total=total, initial=done, unit='step', desc=name, disable=quiet)
    return bar


def has_matplotlib() -> bool:
    """Tell whether curves can be drawn; say once in the log when they cannot."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        _say_no_curves()
        return False
    return True


@cache
def _say_no_curves() -> None:
    _log.warning(
        'matplotlib is not installed, so no curves are drawn; the same command draws curves.png '
        'from training.jsonl and validation.jsonl where it is'
    )
