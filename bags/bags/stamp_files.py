"""Read text files of stamps and of stamped rows."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.skips import Skips
from lcd_common.errors import DataError


def read_date_stamps(path: Path) -> list[int | None]:
    """Read KITTI's timestamps.txt, one `2011-09-26 13:02:25.964389445` a line, as nanoseconds.

    The recordings name no time zone; the times are taken as UTC. A line that is empty or no date is
    None, so that the number of a line stays the number of its file; empty lines at the end are cut.

    Raises:
        DataError: the file is missing, or no line of it is a date.
    """
    try:
        lines = path.read_text(errors='replace').splitlines()
    except OSError:
        raise DataError(f'{path}: missing, so the files beside it have no stamps') from None
    stamps = [_date_ns(line.strip()) for line in lines]
    while stamps and stamps[-1] is None:
        stamps.pop()
    if not stamps:
        raise DataError(f'{path}: expected lines like "2011-09-26 13:02:25.964389445", got none')
    return stamps


def stamps_of_numbers(
    numbers: list[int], lines: list[int | None], path: Path, skips: Skips
) -> dict[int, int]:
    """Return the stamp of each numbered file that has one; the others are counted.

    Line n belongs to file n. Where the files are 0 to n-1 without a gap and exactly n lines hold a
    date, the lines between them are stray (KITTI's extract recordings have such) and are left out.
    """
    dated = [stamp for stamp in lines if stamp is not None]
    contiguous = numbers == list(range(len(numbers)))
    if contiguous and len(dated) == len(numbers) and len(lines) != len(dated):
        skips.note(f'{path}: {len(lines) - len(dated)} empty lines are left out')
        lines = list(dated)
    known: dict[int, int] = {}
    for number in numbers:
        stamp = lines[number] if number < len(lines) else None
        if stamp is not None:
            known[number] = stamp
    missing = len(numbers) - len(known)
    if missing:
        skips.add(
            f'{path.parent.name} file without a stamp',
            path,
            f'{path}: {len(lines)} lines, {len(dated)} of them dates, for files up to number '
            f'{numbers[-1]}; {missing} files without a stamp are left out',
            missing,
        )
    return known


def read_stamped_rows(
    path: Path, columns: int, skips: Skips
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Read comma-separated rows that begin with integer nanoseconds.

    Rows of another length, or that are not finite numbers, are counted and left out.

    Returns:
        Stamps [N] and the other columns [N x columns - 1], in file order.
    """
    stamps: list[int] = []
    rows: list[list[float]] = []
    with path.open(errors='replace') as file:
        for number, line in enumerate(file, start=1):
            fields = line.split(',')
            if len(fields) == 1 and not fields[0].strip():
                continue
            try:
                # Nanoseconds since 1970 do not fit a float.
                stamp, values = int(fields[0]), [float(field) for field in fields[1:]]
            except ValueError:
                stamp, values = 0, []
            if len(values) != columns - 1 or not np.isfinite(values).all():
                message = f'{path}:{number}: expected {columns} numbers, got {line.strip()[:60]!r}'
                skips.add(f'broken row of {path.name}', (path, number), message)
                continue
            stamps.append(stamp)
            rows.append(values)
    return np.array(stamps, np.int64), np.array(rows, np.float64).reshape(-1, columns - 1)


def _date_ns(text: str) -> int | None:
    try:
        stamp = np.datetime64(text, 'ns')
    except ValueError:
        return None
    return None if np.isnat(stamp) else int(stamp.astype(np.int64))
