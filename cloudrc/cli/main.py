"""Run the given command of `cloudrc`; print an error in one line."""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import sys
from collections.abc import Sequence

from cloudrc.cli.output import STDOUT, TABLE, discard_output, end_output, reserve_stdout
from cloudrc.cli.parser import build_parser
from cloudrc.errors import (
    DISK_FULL,
    TOO_MANY_FILES,
    BadInputError,
    CloudrcError,
    InterruptedRunError,
    machine_error,
)
from cloudrc.files import at_place
from cloudrc.runs.interrupts import is_interrupted
from cloudrc.runs.requirements import name_extra
from cloudrc.text import escape

INTERNAL = 70  # EX_SOFTWARE of sysexits.h: a bug of cloudrc, not of the user

NO_LISTENING = errno.EADDRINUSE, errno.EADDRNOTAVAIL
"""Error numbers of an address at which a program cannot listen."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command in `arguments`, or this process's command; return the exit code."""
    if arguments is not None:
        return _run(list(arguments))
    if sys.stdout is None:  # closed by the shell (>&-): nobody wants the result
        sys.stdout = open(os.devnull, "w")
    try:
        return _run(sys.argv[1:])
    finally:
        end_output()


def _run(given: list[str]) -> int:
    try:
        return _dispatch(given)
    except KeyboardInterrupt:
        return InterruptedRunError.exit_code
    except BrokenPipeError:
        discard_output(sys.stdout)  # the reader (head, less) has closed the pipe
        return 0
    except Exception as error:
        if "--debug" in given:
            raise
        if is_interrupted():  # a library has turned the interrupt into an error of its own
            return InterruptedRunError.exit_code
        message, code = _explain(error)
        # Escape text from files, but keep the line breaks of our messages: two blanks follow them.
        shown = "\n  ".join(map(escape, message.split("\n  ")))
        print(f"cloudrc: error: {shown}", file=sys.stderr)
        return code


def _dispatch(given: Sequence[str]) -> int:
    name = next((word for word in given if not word.startswith("-")), None)
    parser = build_parser([name] if name else [])
    if not given:
        parser.print_help()
        return 0
    options = parser.parse_args(given, argparse.Namespace(given=given))
    if name is None:
        raise BadInputError("a command is missing; see 'cloudrc --help'")
    form = getattr(options, "output", TABLE)
    for_programs = isinstance(form, str) and form != TABLE
    with reserve_stdout() if for_programs else contextlib.nullcontext():
        code: int = options.execute(options)
        with at_place(STDOUT):
            sys.stdout.flush()
    return code


def _explain(error: Exception) -> tuple[str, int]:
    if isinstance(error, CloudrcError):
        return str(error).rstrip(), error.exit_code  # one line, or one per wrong key
    if isinstance(error, OSError) and error.errno not in (*DISK_FULL, *TOO_MANY_FILES):
        text, remedy = str(error.strerror or error), "'--debug' shows where"
        if error.filename and error.errno in NO_LISTENING:
            text = f"{error.filename}: {text}"
            remedy = "name an address of this machine, and a port that is free"
        elif error.filename:
            text = f"{error.filename}: {text}"
            remedy = f"check the path, and whether you have access to it ({remedy})"
        return f"{text}; {remedy}", BadInputError.exit_code
    lacking = name_extra(error) if isinstance(error, ModuleNotFoundError) else None
    if failure := lacking or machine_error(error):
        return str(failure), failure.exit_code
    kind, text = type(error).__name__, " ".join(str(error).split())
    return f"internal error: {kind}: {text}; '--debug' shows where, please report it", INTERNAL
