"""Name what can go wrong, so that callers can tell a user's mistake from a defect."""


class LocalizationError(Exception):
    """Base of every error the suite raises on purpose.

    Its text is one line that says what was expected, what came and what to do. Command lines print
    it and exit with status 1; anything else is a defect and keeps its traceback.
    """


class DataError(LocalizationError):
    """A file or message cannot be read as what it claims to be."""


class ConfigError(LocalizationError):
    """A setting is unknown, of the wrong type or out of its range."""


class MapError(LocalizationError):
    """A saved map is missing, incomplete or of another version."""
