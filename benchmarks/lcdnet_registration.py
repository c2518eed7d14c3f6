"""Registration of pairs from simulated drives through test towns, by distance."""

from pathlib import Path
from typing import Any

from bags.simulation.stream import TEST_SEEDS
from benchmarks.lcdnet_drives import methods, rendered
from lcd_common.errors import LocalizationError
from lcd_loop_closure.evaluation.initial_guess import compare_guess
from lcd_loop_closure.evaluation.registration_errors import RegistrationErrors, joined_errors
from lcd_loop_closure.evaluation.registration_pairs import BANDS, Band, choose_pairs
from lcd_loop_closure.evaluation.study import study_registration, terminal_bar
from lcd_loop_closure.evaluation.sweep_views import SectorRemoved, Sweeps

METHODS = (
    'lcdnet', 'lcdnet_accepted', 'lcdnet_ransac', 'lcdnet_fast', 'lcdnet_icp', 'lcdnet_gnc',
    'lcdnet_kiss_matcher', 'kiss_matcher',
    'kiss_matcher_gicp',
    'fpfh_ransac', 'fgr', 'small_gicp', 'icp_point_to_point', 'icp_point_to_plane',
    'scan_context_yaw', 'isc_yaw', 'lidar_iris_yaw',
)  # fmt: skip
# The node's own answer is judged on all pairs; so many of each band do for the others, which need
# seconds for a pair.
_PEERS_PAIRS = 60
_KINDS = ('same_way', 'reverse')
_IN_SECTORS = ('lcdnet', 'lcdnet_ransac', 'lcdnet_fast', 'kiss_matcher', 'fpfh_ransac')


def registration(
    work: Path, towns: int = 3, pairs: int = 1002, length_m: float | None = None
) -> dict[str, Any]:
    """Return figure -> method for each band of distances, and for sectors removed."""
    found: dict[str, dict[str, list[RegistrationErrors]]] = {}
    missing: dict[str, str] = {}
    # Half of the pairs from drives of each class, as many from every town.
    share, few = (-(-number // (len(_KINDS) * towns)) for number in (pairs, _PEERS_PAIRS))
    for kind in _KINDS:
        for seed in TEST_SEEDS[:towns]:
            sweeps = rendered(work, kind, seed, length_m=length_m)
            every, some = (
                {
                    band.name: choose_pairs(sweeps.T_world_base, band, count=count, seed=seed)
                    for band in BANDS
                }
                for count in (share, min(share, few))
            )
            views: list[tuple[Sweeps, str, dict[str, Any], tuple[str, ...]]] = [
                (sweeps, '', every, METHODS[:1]),
                (sweeps, '', some, METHODS[1:]),
            ]
            near = BANDS[0].name
            views += [
                (SectorRemoved(sweeps, width), f'_sector_{width:g}', {near: some[near]},
                 _IN_SECTORS)
                for width in (45.0, 90.0)
            ]  # fmt: skip
            for view, suffix, chosen, names in views:
                results = study_registration(methods(), names, view, chosen, bar=terminal_bar)
                for band, by_method in results.items():
                    for name, errors in by_method.items():
                        if isinstance(errors, str):
                            missing[name] = errors
                        else:
                            at = found.setdefault(band + suffix, {})
                            at.setdefault(name, []).append(errors)
    figures: dict[str, Any] = {band: _by_figure(by_name) for band, by_name in found.items()}
    if missing:
        figures['missing'] = missing
    return {'registration': figures}


def initial_guess(work: Path, pairs: int = 60, length_m: float | None = None) -> dict[str, Any]:
    """Return time and RMSE of ICP from the identity and from LCDNet's answer, by class."""
    figures = {}
    for kind in _KINDS:
        sweeps = rendered(work, kind, TEST_SEEDS[0], length_m=length_m)
        chosen = choose_pairs(sweeps.T_world_base, Band(0.0, 4.0), count=pairs)
        guess = methods().registration('lcdnet_ransac')
        with terminal_bar(f'ICP, {kind}', len(chosen)) as step:
            compared = compare_guess(guess, sweeps.cloud, chosen, progress=step)
        if compared is None:
            raise LocalizationError(f'{sweeps.name} has no pairs to register')
        figures[kind] = compared.plain()
    return {'icp_guess': figures}


def _by_figure(by_name: dict[str, list[RegistrationErrors]]) -> dict[str, dict[str, Any]]:
    figures: dict[str, dict[str, Any]] = {}
    for name, parts in by_name.items():
        for key, value in joined_errors(parts).plain().items():
            figures.setdefault(key, {})[name] = value
    return figures
