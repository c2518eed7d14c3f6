"""Find where a new session lies in a loaded map."""

from dataclasses import dataclass

from lcd_common import se3
from lcd_common.settings import config, setting


@config
class AnchorConfig:
    """When loops say reliably where a new session lies."""

    loops: int = setting(
        2, 'loops of different keyframes that must agree before a session is attached', low=1
    )
    distance: float = setting(2.0, 'largest difference between them', unit='m', low=0.01)
    angle: float = setting(0.1, 'largest difference between them', unit='rad', low=0.001, high=3.2)


@dataclass(frozen=True)
class _Guess:
    query_id: int
    T_map_odom: se3.Array


class SessionAnchor:
    """Collect what loops with the old map say about T_map_odom until enough of them agree.

    Two sessions have no odometry between them: one false loop would put the whole session
    elsewhere, and no residual of the graph would notice.
    """

    kept = 50  # guesses remembered; older ones would be bent by odometry's drift anyway

    def __init__(self, settings: AnchorConfig) -> None:
        self.settings = settings
        self._guesses: list[_Guess] = []

    def add(
        self,
        query_id: int,
        T_map_match: se3.Array,
        T_match_query: se3.Array,
        T_odom_query: se3.Array,
    ) -> se3.Array | None:
        """Take in a loop; return T_map_odom by this loop once enough others agree with it."""
        T_map_odom = T_map_match @ T_match_query @ se3.inverse(T_odom_query)
        T_map_query = T_map_match @ T_match_query
        agree = {query_id}
        for guess in self._guesses:
            # Compared at the vehicle, not at odometry's origin, which may be far away.
            metres, radians = se3.distance(T_map_query, guess.T_map_odom @ T_odom_query)
            if metres <= self.settings.distance and radians <= self.settings.angle:
                agree.add(guess.query_id)
        self._guesses = [*self._guesses, _Guess(query_id, T_map_odom)][-self.kept :]
        return T_map_odom if len(agree) >= self.settings.loops else None
