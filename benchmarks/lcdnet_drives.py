"""Loop detection on simulated drives through test towns, every method on the same sweeps."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.held_out import TEST_SETS
from bags.simulation.stream import TEST_SEEDS
from benchmarks.lcdnet_peers import judge_map_closures
from benchmarks.simulated_drives import SPACING_M
from lcd_loop_closure.evaluation.drive_sweeps import store_drive
from lcd_loop_closure.evaluation.methods import Methods
from lcd_loop_closure.evaluation.study import JudgedMethod, study_detection, terminal_bar
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, is_stored
from lcd_loop_closure.evaluation.sweep_views import (
    Aggregated,
    Joined,
    RearBlocked,
    SectorRemoved,
    Sweeps,
)
from lcd_loop_closure.revisits import RevisitConfig

METHODS = ('lcdnet', 'scan_context', 'scan_context_50', 'm2dp', 'isc', 'lidar_iris')
LENGTH_M = 2500.0
_UNSEEN = 'beams32'
CLASSES = ('same_way', 'reverse')  # of revisits


def methods() -> Methods:
    """Return the methods, LCDNet with the weights that LCDNET_WEIGHTS names or that ship."""
    named = os.environ.get('LCDNET_WEIGHTS')
    return Methods(Path(named) if named else None, device=os.environ.get('LCDNET_DEVICE', 'auto'))


def rendered(
    work: Path,
    kind: str,
    seed: int,
    *,
    run: int = 0,
    sensor: str = 'hdl64',
    length_m: float | None = None,
) -> StoredSweeps:
    """Return the sweeps of a drive through a town, cast the first time and kept in `work`.

    Args:
        work: folder.
        kind: of its revisits, same_way or reverse.
        seed: of the town.
        run: the same streets at another time.
        sensor: LiDAR.
        length_m: of the drive.
    """
    length = LENGTH_M if length_m is None else length_m
    name = f'town_{seed}_{kind}_run{run}_{sensor}_{length:.0f}'
    folder = work / 'sweeps' / name
    if not is_stored(folder):
        journey = replace(TEST_SETS[kind].journey, length=length)
        drive = SimulatedDrive(seed, run, journey, SensorsConfig(lidar=sensor, imu='', gnss=False))
        drive.name = name
        expected = int(length / SPACING_M)
        with terminal_bar(f'casting {name}', expected) as step:
            store_drive(drive, folder, spacing_m=SPACING_M, progress=lambda done, of: step())
    return StoredSweeps(folder)


def detection(work: Path, towns: int = 3) -> dict[str, Any]:
    """Return average precision by protocol, class and method: means over towns, and each town's."""
    found: dict[str, dict[str, Any]] = {}
    for kind in CLASSES:
        for seed in TEST_SEEDS[:towns]:
            sweeps = rendered(work, kind, seed)
            judged = study_detection(
                methods(), METHODS, {'whole': sweeps}, RevisitConfig(),
                folder=work / 'descriptors', bar=terminal_bar,
            )['whole']  # fmt: skip
            found.setdefault(kind, {})[f'town_{seed}'] = judged
    figures: dict[str, Any] = {'ap': _average_precision(found)}
    figures['detection_by_town'] = {
        kind: {town: _plain(judged) for town, judged in by_town.items()}
        for kind, by_town in found.items()
    }
    return figures


def map_closures(work: Path, length_m: float = 800.0) -> dict[str, Any]:
    """Return MapClosures' average precision by class, protocol 1, and that of others beside it.

    Its time grows with the square of the way, so it is given shorter drives through the first town,
    and the others are judged on these too.
    """
    found: dict[str, dict[str, float]] = {}
    for kind in CLASSES:
        sweeps = rendered(work, kind, TEST_SEEDS[0], length_m=length_m)
        judged = study_detection(
            methods(), ('lcdnet', 'scan_context'), {'whole': sweeps}, RevisitConfig(),
            folder=work / 'descriptors', bar=terminal_bar,
        )['whole']  # fmt: skip
        beside = {name: one.detection for name, one in judged.items() if not isinstance(one, str)}
        # Any method tells which revisits are in reverse.
        curve = judge_map_closures(work, sweeps, beside['scan_context'].reverse, kind)
        found[kind] = {
            'map_closures': curve.average_precision,
            **{name: one.protocol_1[kind].average_precision for name, one in beside.items()},
        }
    return {
        'ap': {'protocol1': {k: {'map_closures': v['map_closures']} for k, v in found.items()}},
        'map_closures_drives': {'length_m': length_m, **found},
    }


def changed(work: Path, length_m: float | None = None) -> dict[str, Any]:
    """Return the same for a second run among other cars, and for a sensor not trained on."""
    seed = TEST_SEEDS[0]
    runs = [rendered(work, 'same_way', seed, run=run, length_m=length_m) for run in (0, 1)]
    joined = Joined(runs, f'town_{seed}_runs_0_1_{len(runs[0])}_{len(runs[1])}')
    # Only the second run asks, all of the first is its past.
    traffic = study_detection(
        methods(), METHODS, {'whole': joined}, RevisitConfig(first_scan=len(runs[0])),
        folder=work / 'descriptors', bar=terminal_bar,
    )['whole']  # fmt: skip
    unseen = {}
    for kind in CLASSES:
        sweeps = rendered(work, kind, seed, sensor=_UNSEEN, length_m=length_m)
        unseen[kind] = {
            f'town_{seed}': study_detection(
                methods(), METHODS, {'whole': sweeps}, RevisitConfig(),
                folder=work / 'descriptors', bar=terminal_bar,
            )['whole']
        }  # fmt: skip
    return {
        'ap_other_traffic': _average_precision({'all': {f'town_{seed}': traffic}}),
        f'ap_unseen_{_UNSEEN}': _average_precision(unseen),
    }


def sectors(work: Path, towns: int = 1, length_m: float | None = None) -> dict[str, Any]:
    """Return average precision with sectors removed at random, and with the rear blocked."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in CLASSES:
        for seed in TEST_SEEDS[:towns]:
            sweeps = rendered(work, kind, seed, length_m=length_m)
            blocked = RearBlocked(sweeps)
            views: dict[str, Sweeps] = {
                'sector_45': SectorRemoved(sweeps, 45.0),
                'sector_90': SectorRemoved(sweeps, 90.0),
                'rear_70': blocked,
                'rear_70_aggregated': Aggregated(blocked),
            }
            judged = study_detection(
                methods(), METHODS, views, RevisitConfig(),
                folder=work / 'descriptors', bar=terminal_bar,
            )  # fmt: skip
            for view, of_view in judged.items():
                found.setdefault(view, {}).setdefault(kind, {})[f'town_{seed}'] = of_view
    return {f'ap_{view}': _average_precision(by_kind) for view, by_kind in found.items()}


def _average_precision(
    found: Mapping[str, Mapping[str, Mapping[str, JudgedMethod | str]]],
) -> dict[str, Any]:
    """Return protocol -> class -> method -> mean over towns; `missing` tells what is not there."""
    figures: dict[str, Any] = {'protocol1': {}, 'protocol2': {}}
    missing: dict[str, str] = {}
    for kind, by_town in found.items():
        for protocol in (1, 2):
            values: dict[str, list[float]] = {}
            for judged in by_town.values():
                for name, one in judged.items():
                    if isinstance(one, str):
                        missing[name] = one
                        continue
                    curve = getattr(one.detection, f'protocol_{protocol}')[kind]
                    values.setdefault(name, []).append(curve.average_precision)
            figures[f'protocol{protocol}'][kind] = {
                name: float(np.mean(of_towns)) for name, of_towns in values.items()
            }
    if missing:
        figures['missing'] = missing
    return figures


def _plain(judged: Mapping[str, JudgedMethod | str]) -> dict[str, Any]:
    return {name: one.plain() for name, one in judged.items() if isinstance(one, JudgedMethod)}
