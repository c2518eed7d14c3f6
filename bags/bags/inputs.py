"""Open what a user names: a bag, a data set folder, or a made-up `street` or `town`."""

from collections.abc import Mapping
from pathlib import Path

from bags.drives import open_drive
from bags.records import Drive
from lcd_common.errors import ConfigError, DataError


def open_input(
    name: str | Path,
    *,
    format: str | None = None,
    sequence: str | None = None,
    topics: Mapping[str, str] | None = None,
) -> Drive:
    """Open a drive as `open_drive` does.

    `town` is a short drive through a simulated town, `town:SEED` and `town:SEED:RUN` are longer
    ones through towns of a choice; `street` and `street:ROUTE` are the small analytic town.
    """
    if is_town(name):
        return _town(str(name))
    if is_street(name):
        from bags.street import StreetDrive  # scipy: only for those who drive there

        return StreetDrive(str(name).partition(':')[2] or 'loop')
    return open_drive(Path(name), format=format, sequence=sequence, topics=topics)


def is_street(name: str | Path) -> bool:
    """Tell whether a name means the analytic town; a file or folder of that name comes first."""
    return str(name).partition(':')[0] == 'street' and not Path(name).exists()


def is_town(name: str | Path) -> bool:
    """Tell whether a name means a simulated town; a file or folder of that name comes first."""
    return str(name).partition(':')[0] == 'town' and not Path(name).exists()


def _town(name: str) -> Drive:
    numbers = name.split(':')[1:]
    if len(numbers) > 2 or not all(text.isdecimal() for text in numbers):
        raise ConfigError(f'a simulated town is town:SEED or town:SEED:RUN, got {name!r}')
    from bags.simulation.demonstration import demonstration  # scipy: only for those who drive there
    from bags.simulation.drive import SimulatedDrive

    if not numbers:
        return demonstration()
    seed, run = int(numbers[0]), int(numbers[1]) if len(numbers) > 1 else 0
    return SimulatedDrive(seed, run)


def span_ns(
    drive: Drive, start_s: float = 0.0, duration_s: float | None = None
) -> tuple[int, int | None]:
    """Turn seconds after the drive's first stamp into stamps, both ends inclusive.

    Raises:
        DataError: the drive is empty, or the start lies behind its end.
    """
    streams = [s for s in drive.streams() if s.first_ns is not None and s.last_ns is not None]
    if not streams:
        raise DataError(f'{drive.path}: the drive is empty; bags info shows what could be read')
    first = min(s.first_ns for s in streams if s.first_ns is not None)
    last = max(s.last_ns for s in streams if s.last_ns is not None)
    start = first + round(start_s * 1e9)
    if start > last:
        raise DataError(
            f'{drive.path}: the start must lie within its {(last - first) * 1e-9:.1f} s, '
            f'got {start_s:g} s'
        )
    return start, None if duration_s is None else start + round(duration_s * 1e9)
