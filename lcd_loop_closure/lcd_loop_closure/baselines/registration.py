"""Say what a registration of two whole clouds is, and register in two steps."""

from typing import Any, Protocol

from lcd_common import se3
from lcd_common.cloud import PointCloud


class CloudRegistration(Protocol):
    """Find how two clouds lie to each other, without a guess; `name` is what tables call it."""

    name: str

    def prepare(self, cloud: PointCloud) -> Any:
        """Return what `register` needs of one cloud, made once for each."""

    def register(self, match: Any, query: Any) -> se3.Array | None:
        """Return T_match_query [4 x 4], metres; None where the method itself gives up."""


class CloudRefinement(CloudRegistration, Protocol):
    """A registration that may start from a guess; without one it starts from the identity."""

    def refine(self, match: Any, query: Any, T_match_query: se3.Array) -> se3.Array:
        """Return the pose that a guess leads to."""


class RefinedRegistration:
    """Let one method find the pose and another one refine it."""

    def __init__(self, rough: CloudRegistration, fine: CloudRefinement) -> None:
        self.rough, self.fine = rough, fine
        self.name = f'{rough.name}+{fine.name}'

    def prepare(self, cloud: PointCloud) -> tuple[Any, Any]:
        """Prepare a cloud for both."""
        return self.rough.prepare(cloud), self.fine.prepare(cloud)

    def register(self, match: tuple[Any, Any], query: tuple[Any, Any]) -> se3.Array | None:
        """Return T_match_query; None where the first method gives up."""
        T_match_query = self.rough.register(match[0], query[0])
        return (
            None if T_match_query is None else self.fine.refine(match[1], query[1], T_match_query)
        )
