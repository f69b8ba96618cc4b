"""The one exception users see: what is wrong, with which value, and what to do about it."""

from __future__ import annotations


class MufasaError(ValueError):
    """Bad input, told in one clear line.

    The command line prints the message and exits with 2; the viewer shows it as a notification.
    """


class Cancelled(Exception):
    """Raised inside long work when the user asked it to stop; nothing is left half-written."""


def system_line(error: OSError) -> str:
    """What the system refuses, in one line that says what to do."""
    if error.filename is None or error.strerror is None:
        return f"{error}: check the files and the space on the disk"
    return f"{error.filename}: {error.strerror.lower()}; check the path, its permissions and the space on the disk"
