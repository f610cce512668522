# SPDX-License-Identifier: Apache-2.0

"""Paths that a user names: results never replace what is there, and secrets are read whole."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, TypeVar

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import SIZE_MAX, read, try_lock

PICTURES = {
    "png": re.compile(rb"\x89PNG\r\n\x1a\n"),
    "svg": re.compile(rb"(<\?xml[^>]*>\s*)?<(!DOCTYPE )?svg\b"),
    "pdf": re.compile(rb"%PDF-"),
}
"""Kind of a picture -> how its files begin."""
LOCK = ".lock"
"""File of a folder that each command locks; the names of further locks begin so."""
TOKEN_VARIABLE = "CLOUDRC_TOKEN_FILE"
"""Environment variable of a command that names the file with the API's token."""
_taken = list[int]()
"""The descriptor of the newest folder of results, which is locked; or none."""
_TOKEN = re.compile(rb"[!-~]{16,512}")
_Secret = TypeVar("_Secret")


def check_new(path: Path, remedy: str = "name another file with -o") -> None:
    """Raise a BadInputError if writing to `path` would replace a file that is not empty.

    Writing to a device or a pipe replaces nothing.
    """
    if path.is_file() and path.stat().st_size:
        raise BadInputError(f"{path}: already there; {remedy}")


def check_picture(path: Path, flag: str) -> None:
    """Check that `path` is new or a picture, and that its name has the ending of a picture."""
    own = PICTURES.get(path.suffix[1:])
    if own is None:
        known = ", ".join(f".{each}" for each in PICTURES)
        raise BadInputError(f"{flag} {path}: no kind of picture; use one of {known}")
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(256)
        if own.match(start) is None:
            check_new(path, f"name another file with {flag}")


def make_folder(folder: Path, named: str = "") -> None:
    """Make a folder for results; `named` precedes its path in errors, as the flag that gave it.

    Of commands that begin at the same time, one gets the folder: it locks the folder until it makes
    its next one, so long before that the folder is not empty.

    Raise a BadInputError if it exists and is not an empty folder, if another command has it, or if
    it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        while _taken:
            os.close(_taken.pop())
        _taken.append(os.open(folder, os.O_RDONLY))
        is_used = try_lock(_taken[0]) is False or any(folder.iterdir())
    except FileExistsError:
        is_used = True
    except OSError as error:
        text = f"cannot be made: {error.strerror}; name a writable folder"
        raise BadInputError(f"{named}{folder}: {text}") from error
    if is_used:
        text = "already exists; name a new folder, nothing is overwritten"
        raise BadInputError(f"{named}{folder}: {text}")


def lock(file: IO[Any], text: str, *, shared: bool = False) -> None:
    """Lock a file for this command alone, or `shared` with others of its kind, until it is closed.

    Raise a BadInputError with the `text` if another command has locked it. On NFS, a process loses
    the lock when it closes any other handle of the file.
    """
    if try_lock(file, shared=shared) is False:
        raise BadInputError(text)


@contextmanager
def lock_folder(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Lock a folder of results for a shard, a number and how many there are, or for one command.

    Shards lock it together, and each its own number. Raise a BadInputError if another command flies
    the same flights into the folder.
    """
    names = [LOCK, *(["{}-{}-of-{}".format(LOCK, *shard)] if shard else [])]
    text = f"--out {folder}: another command flies into it now; wait for its end"
    with ExitStack() as stack:
        for name in names:
            file = stack.enter_context((folder / name).open("a+"))
            lock(file, text, shared=bool(shard) and name == LOCK)
        yield


def check_there(path: Path, remedy: str) -> None:
    """Raise a BadInputError if nothing is at `path`."""
    if not path.exists():
        raise BadInputError(f"{path}: no such file or folder; {remedy}")


def read_file(path: Path, named: str, remedy: str, size_max: int = SIZE_MAX) -> bytes:
    """Read a file of the user's; never block, even if it is a pipe.

    If that fails, raise a BadInputError with `named`, what the file is, the reason and a `remedy`.
    """
    try:
        return read(path, size_max)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).removeprefix(f"{path}: ")
        raise BadInputError(f"{named}: {reason}; {remedy}") from None


def read_secret(
    path: Path, named: str, parse: Callable[[bytes], _Secret], make: str, size_max: int = SIZE_MAX
) -> _Secret:
    """Read a file with a secret.

    If `parse` raises a ValueError about its content, raise a BadInputError that contains no part of
    the file: `named` and the reason. `make` is the command that makes such a file.
    """
    data = read_file(path, named, f"make one: {make}", size_max)
    try:
        return parse(data)
    except ValueError as error:
        reason = str(error)
    raise BadInputError(f"{named}: {reason}; make one: {make}")


def read_token(path: Path, named: str) -> str:
    """Read the token of teleop's API from a file, as `read_secret` does."""
    return read_secret(path, named, _parse_token, f"(umask 077; openssl rand -hex 32 > {path})")


def read_tokens(folder: Path, roles: Iterable[str]) -> dict[str, str]:
    """Read the tokens of the first of the `roles` and of those that have a file in `folder`.

    Return token -> role. Raise a BadInputError, which contains no token, if one is not valid, or if
    two roles have the same.
    """
    found = dict[str, str]()
    for role in roles:
        path = folder / role
        if found and not path.exists():
            continue
        token = read_token(path, f"--tokens: {path}")
        if token in found:  # then a reader's token would allow commands
            raise BadInputError(f"--tokens {folder}: both roles have the same token")
        found[token] = role
    return found


def _parse_token(data: bytes) -> str:
    if _TOKEN.fullmatch(data.strip()):
        return data.strip().decode("ascii")
    raise ValueError("a token is 16 to 512 visible ASCII characters")
