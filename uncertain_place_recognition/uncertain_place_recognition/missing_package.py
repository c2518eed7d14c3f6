"""Import packages that are no part of the suite's installation."""

import importlib
from typing import Any

from lcd_common.errors import LocalizationError


class MissingPackageError(LocalizationError):
    """A chosen part needs a package that is not installed."""


def optional_package(module: str, requirement: str, purpose: str) -> Any:
    """Return a module; raises MissingPackageError that says what to install, and what for."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingPackageError(
            f'{purpose} needs the package {requirement.split("==")[0]}: pip install {requirement}'
        ) from None
