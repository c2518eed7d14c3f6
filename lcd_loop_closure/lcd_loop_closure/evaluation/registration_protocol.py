"""What a registration of two clouds offers to be evaluated."""

from typing import Protocol, TypeVar

from lcd_common import se3
from lcd_common.cloud import PointCloud

Prepared = TypeVar('Prepared')


class CloudRegistration(Protocol[Prepared]):
    """Register two clouds without an initial guess; `name` is what users call it."""

    name: str

    def prepare(self, cloud: PointCloud) -> Prepared:
        """Return what is needed of a sweep in the base frame; done once for each cloud."""

    def register(self, match: Prepared, query: Prepared) -> se3.Array | None:
        """Return T_match_query, or None when there is no answer."""
