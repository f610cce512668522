"""The command `cloudrc`: finds the command's file, runs it, and turns errors into one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from cloudrc.cli.parser import COMMANDS, build, unknown
from cloudrc.errors import BadInputError, CloudrcError

INTERRUPTED = 130
INTERNAL = 70  # EX_SOFTWARE of sysexits.h: ours to mend, not the user's


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line.

    Args:
        arguments: Without the program's name; default: those of this process.

    Returns:
        The exit code; the design's table of codes is in `cloudrc --help`.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(given)
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        # The reader (head, less) has left. Python would complain when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if "--debug" in given:
            raise
        message, code = _explain(error)
        print(f"cloudrc: error: {message}", file=sys.stderr)
        return code


def _dispatch(given: Sequence[str]) -> int:
    name = next((word for word in given if not word.startswith("-")), None)
    if name is not None and name not in COMMANDS:
        raise BadInputError(f"unknown command: {unknown(name, COMMANDS)}; see 'cloudrc --help'")
    parser = build([name] if name else [])
    if not given:
        parser.print_help()
        return 0
    options = parser.parse_args(given)
    if name is None:
        raise BadInputError("a command is missing; see 'cloudrc --help'")
    code: int = options.execute(options)
    sys.stdout.flush()
    return code


def _explain(error: Exception) -> tuple[str, int]:
    """Put an error into words, with the exit code that belongs to it."""
    if isinstance(error, CloudrcError):
        return str(error).rstrip(), error.exit_code  # one line, or one for each wrong key
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}", BadInputError.exit_code
    kind = type(error).__name__
    text = " ".join(str(error).split())
    return f"internal error: {kind}: {text}; '--debug' shows where, please report it", INTERNAL
