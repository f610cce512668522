"""Flag and environment variable that name the file with the token of teleop's API.

The token is read from a file, because a token on the command line would appear in the list of
processes and in the history of the shell.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from cloudrc.cli.output import tell
from cloudrc.cli.parser import Options, flags
from cloudrc.files import warn_if_readable
from cloudrc.outside.paths import read_token
from cloudrc.teleop.client import VARIABLE


def token_argument(parser: argparse._ActionsContainer) -> None:
    """Declare the argument --token-file."""
    text = f"file with the API's token (default: from {VARIABLE}, or the release's Secret)"
    flags(parser)("--token-file", "FILE", text)


def given_token(options: Options) -> Callable[[], str] | None:
    """Return a function that reads the token from the file that the user has named, else None.

    The flag comes before the environment. Print a warning if other users can read the file.
    """
    if path := options.token_file:
        named = f"--token-file {path}"
    elif name := os.environ.get(VARIABLE):
        path, named = Path(name), f"{VARIABLE}={name}"
    else:
        return None
    warn_if_readable(path, tell)
    return lambda: read_token(path, named)
