"""Errors that a user can mend: one line that says what, where and what to do next."""

from __future__ import annotations


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
