"""Read runs of the PointNetVLAD benchmark (Oxford, U.S., R.A., B.D.), as its authors published it.

    oxford/RUN/{pointcloud_locations_*.csv, pointcloud_*/STAMP.bin}
    inhouse_datasets/RUN/{pointcloud_centroids_*.csv, pointcloud_25m_*/STAMP.bin}

A .bin is 4096 rows of x y z in float64, already normalised (`submap.benchmark_normalised`); the
table has the columns timestamp, northing, easting. A run may hold several sets: pointcloud_20m for
tests and pointcloud_20m_10overlap for training (Oxford), pointcloud_25m_25 for tests and
pointcloud_25m_10 for training (the others). Which submaps are for tests: `regions`.
"""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError
from uncertain_place_recognition.runs import SubmapRun

POINTS = 4096
_BYTES = POINTS * 3 * 8
_TABLES = ('pointcloud_locations_', 'pointcloud_centroids_')
# Normalised submaps lie within 1, 0.5 from their middle in the mean. Pairs of float32 numbers read
# as float64 are near zero, metres are far outside.
_LARGEST, _LEAST_SPREAD = 1.5, 0.05


def read_benchmark_submap(path: Path) -> NDArray[np.float32]:
    """Return one submap [4096 x 3] in the benchmark's units.

    Raises:
        DataError: the file has another length, or its numbers are none of float64.
    """
    raw = path.read_bytes()
    if len(raw) != _BYTES:
        hint = (
            '; half as long: float32 is not what the benchmark has'
            if len(raw) * 2 == _BYTES
            else ''
        )
        raise DataError(
            f'{path}: expected {_BYTES} bytes ({POINTS} points of float64 x y z), got '
            f'{len(raw)}{hint}'
        )
    points = np.frombuffer(raw, '<f8').reshape(POINTS, 3)
    size = float(np.abs(points).max()) if np.isfinite(points).all() else float('inf')
    spread = float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean()) if size < 1e9 else 0
    if size > _LARGEST or spread < _LEAST_SPREAD:
        raise DataError(
            f'{path}: expected float64 coordinates within -1 .. 1, about 0.5 from their middle; '
            f'the largest is {size:.3g}, the mean {spread:.3g} from it; is the file float32, or '
            'not normalised?'
        )
    return points.astype(np.float32)


def read_benchmark_run(folder: Path, submaps: str = '', world: str = '') -> SubmapRun:
    """Return a run of the benchmark; easting is x and northing y, headings are not known.

    Args:
        folder: of the run.
        submaps: the set of submaps, e.g. 'pointcloud_20m'; needed where there are several.
        world: empty: the site, the folder that the run lies in.

    Raises:
        DataError: the set or its table is missing, or a row has no file.
    """
    sets = sorted(p.name for p in folder.glob('pointcloud_*') if p.is_dir())
    chosen = submaps or (sets[0] if len(sets) == 1 else '')
    if chosen not in sets:
        raise DataError(
            f'{folder}: expected one folder of submaps, got {", ".join(sets) or "none"}; choose '
            'with submaps'
        )
    tables = sorted(t for kind in _TABLES for t in folder.glob(f'{kind}*.csv'))
    # pointcloud_25m_10 belongs to pointcloud_centroids_10.csv, pointcloud_20m to .._locations_20m.
    suffix = chosen.removeprefix('pointcloud_')
    suffixes = {suffix, suffix.removeprefix('25m_')}
    fitting = [t for t in tables if _suffix(t) in suffixes]
    candidates = fitting or tables
    if len(candidates) != 1:
        names = ', '.join(t.name for t in tables) or 'none'
        raise DataError(
            f'{folder}: expected pointcloud_locations_{suffix}.csv (or _centroids_), got {names}'
        )
    rows = _rows(candidates[0])
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :2, 3] = [(easting, northing) for _, northing, easting in rows]
    points = np.empty((len(rows), POINTS, 3), np.float16)
    for k, (stamp, _, _) in enumerate(rows):
        points[k] = read_benchmark_submap(folder / chosen / f'{stamp}.bin')
    # The benchmark's stamps are microseconds.
    stamps = np.array([int(stamp) * 1000 for stamp, _, _ in rows], np.int64)
    facts = {'normalisation': 'benchmark', 'set': chosen}
    name = f'{folder.parent.name}_{folder.name}'
    return SubmapRun(name, world or folder.parent.name, stamps, poses, points, facts)


def _suffix(table: Path) -> str:
    """Return what the name of a table says after its kind: 20m, 20m_10overlap, 10, 25."""
    name = table.stem
    for kind in _TABLES:
        name = name.removeprefix(kind)
    return name


def _rows(table: Path) -> list[tuple[str, float, float]]:
    with table.open(newline='') as file:
        reader = csv.DictReader(file)
        try:
            rows = [
                (row['timestamp'].strip(), float(row['northing']), float(row['easting']))
                for row in reader
            ]
            for stamp, _, _ in rows:
                int(stamp)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f'{table}: expected the columns timestamp, northing, easting with numbers ({error})'
            ) from None
    if not rows:
        raise DataError(f'{table}: has no rows')
    return rows
