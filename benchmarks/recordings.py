"""Find the recordings that benchmarks run on; none of them is part of the repository."""

import os
import subprocess
import sys
from pathlib import Path

from lcd_common.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'benchmarks' / 'results'


def folder() -> Path:
    """Return the folder that holds `data` and `tools`: $RECORDINGS or ../shared.

    Raises:
        DataError: it is not there.
    """
    path = Path(os.environ.get('RECORDINGS', ROOT.parent / 'shared'))
    if not (path / 'data').is_dir():
        raise DataError(
            f'{path}: expected the folder of recordings (data/, tools/); '
            'set RECORDINGS to where it is'
        )
    return path


def karlsruhe_out_and_back(work: Path) -> Path:
    """Unpack the out-and-back drive (real sweeps, semi-synthetic order) and return its sequence."""
    out = work / 'karlsruhe'
    if not (out / 'poses' / '00.txt').is_file():
        tool = folder() / 'tools' / 'karlsruhe_drive.py'
        subprocess.run([sys.executable, str(tool), str(out), '--out-and-back'], check=True)
    return out / 'sequences' / '00'
