"""Count what could not be read, and say it once."""

import logging
from collections import Counter
from collections.abc import Hashable

from lcd_common.errors import DataError

_log = logging.getLogger(__name__)
_LINES_PER_CAUSE = 3


class UnreadableError(DataError):
    """One record cannot be read; the drive goes on without it.

    Attributes:
        cause: what is counted, the same for all records with this defect.
    """

    def __init__(self, cause: str, message: str) -> None:
        super().__init__(message)
        self.cause = cause


class Skips:
    """Count skipped records by cause; a drive that is read twice counts each of them once."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._known: set[Hashable] = set()
        self._lines: Counter[str] = Counter()

    def add(self, cause: str, what: Hashable, message: str, number: int = 1) -> None:
        """Count `number` items under `cause` and log why, unless `what` is counted already."""
        if (cause, what) in self._known:
            return
        self._known.add((cause, what))
        self.counts[cause] += number
        self._lines[cause] += 1
        if self._lines[cause] <= _LINES_PER_CAUSE:
            _log.warning('%s', message)
        if self._lines[cause] == _LINES_PER_CAUSE:
            _log.warning('further cases of "%s" are only counted', cause)

    def note(self, message: str) -> None:
        """Log what was noticed and mended, with nothing lost."""
        _log.warning('%s', message)
