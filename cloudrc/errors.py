"""Errors that a user can mend: one line that says what, where and what to do next.

And what foreign code or files say, made fit to be told: as long as they like, in any characters.
"""

from __future__ import annotations

TEXT_MAX = 2000
"""Of foreign words so many characters are told."""


class CloudrcError(Exception):
    """Something the user can mend; `exit_code` is what the command ends with."""

    exit_code = 1


class BadInputError(CloudrcError):
    """A file, key, flag or value that cannot be used."""

    exit_code = 2


class MissingPrerequisiteError(CloudrcError):
    """A package, program or permission that is not there."""

    exit_code = 3


class InvalidRunError(CloudrcError):
    """The run was not what was asked for: not in real time, or a process died."""

    exit_code = 6


class TimedOutError(CloudrcError):
    """Something did not happen in the time that it had."""

    exit_code = 4


class InterruptedRunError(CloudrcError):
    """A person ended the run before there was anything to report."""

    exit_code = 130


def in_one_line(text: str) -> str:
    """Cut foreign words to a line that can be told anywhere: half a surrogate cannot be written."""
    line = " ".join(text[:TEXT_MAX].split())
    return line.encode("utf-8", "backslashreplace").decode("utf-8")


def in_words(error: BaseException) -> str:
    """Say in one line what an exception is and says, whoever wrote it."""
    name = type(error).__name__
    try:
        return in_one_line(f"{name}: {error}")
    except KeyboardInterrupt:
        raise
    except BaseException:  # its words are foreign code, too
        return in_one_line(name)
