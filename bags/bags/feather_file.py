"""Read columns of feather files (Arrow's file format) as arrays."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError


def read_columns(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[np.generic]]:
    """Return numeric columns by name.

    Raises:
        DataError: the file is missing or damaged, or a column is missing, incomplete or no numbers.
    """
    table = _read(path, names)
    columns: dict[str, NDArray[np.generic]] = {}
    for name in names:
        try:
            # Not to_numpy: that imports pandas for nothing.
            columns[name] = np.from_dlpack(table[name].combine_chunks()).copy()
        except (TypeError, ValueError, BufferError) as error:
            raise DataError(f'{path}: the column {name} must be numbers: {error}') from None
    return columns


def read_names(path: Path, column: str) -> list[str]:
    """Return a column of names; raises DataError as `read_columns` does."""
    return [str(name) for name in _read(path, (column,))[column].to_pylist()]


def _read(path: Path, names: tuple[str, ...]) -> Any:
    # A third of a second to import: only for those who read this format.
    import pyarrow as pa
    from pyarrow import ipc

    try:
        with pa.OSFile(str(path)) as file:
            table = ipc.open_file(file).read_all()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DataError(f'{path}: not a readable feather file: {error}') from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        has = ', '.join(table.column_names)
        raise DataError(f'{path}: the column {", ".join(missing)} is missing; it has {has}')
    return table
