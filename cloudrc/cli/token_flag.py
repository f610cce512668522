"""Flag and environment variable that name the file with the token of teleop's API.

The token is read from a file, because a token on the command line would appear in the list of
processes and in the history of the shell.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cloudrc.cli.output import print_line
from cloudrc.errors import BadInputError
from cloudrc.files import read_token, warn_if_readable
from cloudrc.teleop.client import VARIABLE


def token_argument(parser: argparse._ActionsContainer) -> None:
    """Declare the argument --token-file."""
    text = f"file with the API's token (default: from {VARIABLE}, or the release's Secret)"
    parser.add_argument("--token-file", type=Path, metavar="FILE", help=text)


class TokenFile(NamedTuple):
    """A file with a token; `given` is how the user named it, for errors."""

    path: Path
    given: str


def token_file(options: argparse.Namespace) -> TokenFile | None:
    """Return the token file from the flag, else from the environment, else None."""
    if path := options.token_file:
        return TokenFile(path, f"--token-file {path}")
    if name := os.environ.get(VARIABLE):
        return TokenFile(Path(name), f"{VARIABLE}={name}")
    return None


def given_token(options: argparse.Namespace) -> Callable[[], str] | None:
    """Return a function that reads the token from the file that the user has named, else None.

    Print a warning if other users can read the file.
    """
    return token_reader(file) if (file := token_file(options)) else None


def token_reader(file: TokenFile) -> Callable[[], str]:
    """Return a function that reads the token from `file`, as `given_token` does."""
    warn_if_readable(file.path, lambda text: print_line(f"cloudrc: {text}", sys.stderr))
    return lambda: _read(file)


def _read(file: TokenFile) -> str:
    try:
        return read_token(file.path)
    except ValueError as error:
        raise BadInputError(f"{file.given}: {error}; name another file") from None
