"""Show an operator the map and the last answer."""

from collections.abc import Callable

from lcd_common.nodes.diagnostics import Diagnostics
from uncertain_place_recognition.place import PlaceAnswer

_NONE_YET = 'no answer yet'


class AnswerWatch:
    """Report the places and what the last answer was based on.

    Of the last answer, because asking a shared map for its size may take as long as its timeout.
    """

    def __init__(self, diagnostics: Diagnostics, places: Callable[[], int]) -> None:
        """Report from now on; `places` counts those of this vehicle."""
        self._last: PlaceAnswer | None = None
        diagnostics.watch('places', places)
        diagnostics.watch('places searched for the last answer', self._searched)
        diagnostics.watch('uncertainty of the last answer, normalised', self._uncertainty)

    def take(self, answer: PlaceAnswer) -> None:
        """Take in the newest answer."""
        self._last = answer

    def _searched(self) -> int | str:
        return _NONE_YET if self._last is None else self._last.database_size

    def _uncertainty(self) -> str:
        return _NONE_YET if self._last is None else f'{self._last.uncertainty_normalised:.5f}'
