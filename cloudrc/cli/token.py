"""The token that a command sends to teleop's API: a flag comes in, the token's reader goes out.

It comes from a file, so that neither the process table nor a shell's history has it.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import read

VARIABLE = "CLOUDRC_TOKEN_FILE"
SIZE_MAX = 4096
"""Longest token file that is read [bytes]; it may end in blanks."""
_TOKEN = re.compile(r"[!-~]{16,512}")


def token_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag."""
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help=f"file with the API's token (default: that of {VARIABLE}, or the release's Secret)",
    )


def token_file(options: argparse.Namespace) -> Path | None:
    """Say which file has the token: the flag's, else the environment's, else none."""
    if options.token_file is not None:
        return Path(options.token_file)
    return Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None


def reader(path: Path | None) -> Callable[[], str]:
    """Give what reads the token from its file, every time, since it may change; "" without one."""
    return (lambda: "") if path is None else (lambda: _read(path))


def _read(path: Path) -> str:
    try:
        token = read(path, SIZE_MAX).decode("ascii").strip()
    except OSError as error:
        raise BadInputError(f"--token-file {path}: {error.strerror}; name a file") from None
    except ValueError:
        token = ""
    if not _TOKEN.fullmatch(token):
        raise BadInputError(f"--token-file {path}: holds no token; name another file")
    return token
