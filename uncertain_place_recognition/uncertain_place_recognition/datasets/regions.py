"""Know the test regions of the PointNetVLAD benchmark: squares that training leaves out.

The centres are those of the authors' generate_test_sets.py. Queries of the benchmark come from test
regions alone, databases are whole runs; of the business district everything is for tests.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import ConfigError

HALF_WIDTH_M = 150.0
# Northing and easting, metres; Oxford's in UTM, the others in their own national grid.
CENTRES: dict[str, tuple[tuple[float, float], ...]] = {
    'oxford': (
        (5735712.768124, 620084.402381),
        (5735611.299219, 620540.270327),
        (5735237.358209, 620543.094379),
        (5734749.303802, 619932.693364),
    ),
    'university': (
        (363621.292362, 142864.19756),
        (364788.795462, 143125.746609),
        (363597.507711, 144011.414174),
    ),
    'residential': (
        (360895.486453, 144999.915143),
        (362357.024536, 144894.825301),
        (361368.907155, 145209.663042),
    ),
}
ALL_TEST = 'business'
SITES = (*CENTRES, ALL_TEST)


def in_test_region(positions: NDArray[np.float64], site: str) -> NDArray[np.bool_]:
    """Tell [N] which positions [N x 2] (easting, northing) lie in a test region of a site.

    Raises:
        ConfigError: there is no such site.
    """
    if site not in SITES:
        raise ConfigError(f'no site {site!r} in the benchmark; there are {", ".join(SITES)}')
    if site == ALL_TEST:
        return np.ones(len(positions), bool)
    centres = np.array(CENTRES[site])[:, ::-1]
    offsets = np.abs(positions[:, None] - centres)
    found: NDArray[np.bool_] = (offsets < HALF_WIDTH_M).all(axis=2).any(axis=1)
    return found


def in_any_test_region(positions: NDArray[np.float64], sites: list[str]) -> NDArray[np.bool_]:
    """Tell [N] which positions [N x 2] lie in a test region of one of several sites."""
    inside = np.zeros(len(positions), bool)
    for site in sites:
        inside |= in_test_region(positions, site)
    return inside
