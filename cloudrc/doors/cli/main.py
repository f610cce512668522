# SPDX-License-Identifier: Apache-2.0

"""Run the given command of `cloudrc`; print an error in one line."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

from cloudrc.base.errors import (
    DISK_FULL,
    TOO_MANY_FILES,
    BadInputError,
    CloudrcError,
    InterruptedRunError,
    machine_error,
)
from cloudrc.base.files import at_place
from cloudrc.base.requirements import name_extra
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import STDOUT, TABLE, discard_output, open_streams, reserve_stdout
from cloudrc.doors.cli.parser import build_parser
from cloudrc.flight.interrupts import interrupt_on_signals, is_interrupted

INTERNAL = 70  # EX_SOFTWARE of sysexits.h: a bug of cloudrc, not of the user


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command in `arguments`, or this process's command; return the exit code."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    open_streams()
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
    interrupt_on_signals()  # first: until then, the first process of a container ignores SIGTERM
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
        code: int = options.execute(options) or 0
        with at_place(STDOUT):
            sys.stdout.flush()
    return code


def _explain(error: Exception) -> tuple[str, int]:
    if isinstance(error, CloudrcError):
        return str(error).rstrip(), error.exit_code  # one line, or one per wrong key
    if isinstance(error, OSError) and error.errno not in (*DISK_FULL, *TOO_MANY_FILES):
        place = f"{error.filename}: " if error.filename else ""
        remedy = "check path, address and your access to it; '--debug' shows where"
        return f"{place}{error.strerror or error}; {remedy}", BadInputError.exit_code
    lacking = name_extra(error) if isinstance(error, ModuleNotFoundError) else None
    if failure := lacking or machine_error(error):
        return str(failure), failure.exit_code
    kind, text = type(error).__name__, " ".join(str(error).split())
    return f"internal error: {kind}: {text}; '--debug' shows where, please report it", INTERNAL
