"""Run a command as users expect: known mistakes are one line, defects keep their traceback."""

import logging
import sys
from collections.abc import Callable

from lcd_common.errors import LocalizationError


def run(command: Callable[[], int | None]) -> int:
    """Call `command`; a LocalizationError or a missing file becomes one line and status 1.

    Returns the process's exit status: the command's own, 0 for None, 130 after Ctrl-C.
    """
    logging.basicConfig(level=logging.INFO, format='%(levelname)s %(name)s: %(message)s')
    try:
        return command() or 0
    except LocalizationError as error:
        sys.stderr.write(f'error: {error}\n')
        return 1
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError) as error:
        sys.stderr.write(f'error: {error.filename}: {error.strerror}\n')
        return 1
    except KeyboardInterrupt:
        sys.stderr.write('interrupted\n')
        return 130
    except BrokenPipeError:
        return 0
