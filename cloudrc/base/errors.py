# SPDX-License-Identifier: Apache-2.0

"""Errors that a user can fix: one line that says what is wrong, where, and what to do."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cloudrc.wire.records import ControllerLost

DISK_FULL = {errno.ENOSPC: "disk full", errno.EDQUOT: "disk quota used up"}
"""Error number (errno) of a full disk -> text for the user."""
TOO_MANY_FILES = {
    errno.EMFILE: "raise 'ulimit -n', the limit of one process",
    errno.ENFILE: "end other programs, the limit is that of the machine",
}
"""Error number (errno) of a limit of open files and connections -> what to do."""
TEXT_MAX = 2000
"""Largest length of another program's text in a message [characters]; the rest is cut off."""


class CloudrcError(Exception):
    """An error that the user can fix; the command exits with `exit_code`.

    Its text is `cause` and, where it stands apart, `fix`: what to do.
    """

    exit_code = 1

    def __init__(self, *words: object, fix: str = "") -> None:
        """Set what is wrong, and what to do about it."""
        super().__init__(*words)
        self.fix = fix

    @property
    def cause(self) -> str:
        """What is wrong."""
        return super().__str__()

    def __str__(self) -> str:
        return f"{self.cause}; {self.fix}" if self.fix else self.cause


class BadInputError(CloudrcError):
    """A file, key, option or value cannot be used."""

    exit_code = 2


class PlacedError(ValueError):
    """A user's file cannot be used; the text begins with the file, and its line if there is one."""


class NothingFlownError(BadInputError):
    """Nothing was flown that could be shown, reported or compared."""


class StateError(BadInputError):
    """What is there does not allow it now; the text says what to do first."""


class RejectedError(BadInputError):
    """Another process, or netem, has judged the input, and does not take it; the text is its."""


class MissingPrerequisiteError(CloudrcError):
    """A package, program or permission is missing."""

    exit_code = 3


class OutOfMemoryError(MissingPrerequisiteError):
    """The machine has too little memory for a user's code or model."""


class DiskFullError(MissingPrerequisiteError):
    """The disk is full, so that the recording or the report is not complete."""

    def __init__(self, where: str) -> None:
        """Set `where`, the file or folder on the full disk."""
        super().__init__(where)  # pickle passes these arguments to the parent process

    @property
    def cause(self) -> str:
        """What is wrong."""
        return f"disk_full: {self.args[0]}: free some space, or choose another place"


class InvalidRunError(CloudrcError):
    """The run is invalid: it did not keep real time, or one of its processes failed."""

    exit_code = 6


class TimedOutError(CloudrcError):
    """A timeout expired."""

    exit_code = 4


class ControllerLostError(CloudrcError):
    """The program that controls the robot from outside is silent or answers wrongly."""

    exit_code = 5

    def __init__(self, code: ControllerLost, text: str) -> None:
        """Set the `code` for programs, and the text for users."""
        super().__init__(code, text)  # pickle passes these arguments to the parent process
        self.code: ControllerLost = code

    @property
    def cause(self) -> str:
        """What is wrong."""
        return str(self.args[1])


class InterruptedRunError(CloudrcError):
    """The user interrupted the run before there was a result to report."""

    exit_code = 130


_NO_MEMORY = ("could not allocate", "failed to map segment")
"""Words of MuJoCo and of the loader of libraries if memory ran out, in lower case."""


def tells_no_memory(text: str) -> bool:
    """Return whether the text of an error says that memory ran out."""
    return any(words in text.lower() for words in _NO_MEMORY)


def machine_error(error: BaseException) -> MissingPrerequisiteError | None:
    """Return the error to report if the machine has raised `error`; None for all other errors.

    A package that cannot be imported, a lack of memory, a full disk and a missing permission say
    nothing about the flight in which they occur: it must be flown again.
    """
    if isinstance(error, MissingPrerequisiteError):
        return error
    if isinstance(error, OSError):
        if error.errno in DISK_FULL:
            return DiskFullError(str(error.filename or "a file"))
        where = f"{error.filename}: " if error.filename else ""
        text = to_one_line(f"{where}{error.strerror or error}")
        remedy = TOO_MANY_FILES.get(error.errno or 0, "check disk, path and permissions")
        return MissingPrerequisiteError(f"{text}; {remedy}")
    if isinstance(error, MemoryError) or tells_no_memory(describe_error(error)):
        return MissingPrerequisiteError(
            f"memory ran out ({describe_error(error)}); use fewer processes, or free some memory"
        )
    if isinstance(error, ImportError):
        return MissingPrerequisiteError(
            f"a package cannot be imported ({describe_error(error)}); install it again"
        )
    return None


def to_one_line(text: str | None) -> str:
    """Convert text from another program or file to one printable line; None becomes ""."""
    line = " ".join((text or "")[:TEXT_MAX].split())
    return line.encode("utf-8", "backslashreplace").decode("utf-8")


def describe_error(error: BaseException) -> str:
    """Describe an exception in one line: its type and its message."""
    name = type(error).__name__
    text = to_one_line(f"{name}: {error}")
    return f"{text} (sys.exit() was called)" if isinstance(error, SystemExit) else text
