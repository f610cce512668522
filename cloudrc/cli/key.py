"""`cloudrc key`: make or rotate the tunnel's pre-shared key."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line
from cloudrc.errors import BadInputError

REMEDY = "name a key file; 'cloudrc key new FILE' makes a new one"

if TYPE_CHECKING:
    from cloudrc.tunnel.keys import KeySet

EPILOG = """\
World and cloud read the same key file ('--key FILE'; in a cluster, a Secret)
and read it again when it changes. 'new' on an existing file rotates the key:
each end accepts the old key beside the new one for the overlap, counted from
the moment that it reads the file. So no datagram is lost meanwhile. An end
that starts later accepts the old key only until the time stored in the file.
A second 'new' within that time is refused, because an end that has not read
the file yet would be cut off: wait, or revoke the old key with '--drop'.
'retire' removes the old key from the file: each end refuses it within a second.
If a key has leaked: 'new', then 'retire' once both ends have read the file. In
a cluster, run after each of them:
  kubectl create secret generic NAME --from-file=key=FILE \\
    --dry-run=client -o yaml | kubectl apply -f -"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    new = verbs.add_parser("new", help="make a key file, or rotate the key in one")
    new.add_argument("file", type=Path, metavar="FILE", help="key file to write, with mode 0600")
    new.add_argument(
        "--overlap",
        type=_seconds,
        default=None,
        metavar="SECONDS",
        help="time that the old key stays valid after a rotation (default: 300)",
    )
    new.add_argument(
        "--drop",
        action="store_true",
        help="revoke at once the old key of an unfinished rotation",
    )
    retire = verbs.add_parser("retire", help="remove the old key of a rotation early")
    retire.add_argument("file", type=Path, metavar="FILE", help="key file made by 'new'")


def execute(options: argparse.Namespace) -> int:
    """Make a key, or retire the old one."""
    return _retire(options.file) if options.verb == "retire" else _make(options)


def _make(options: argparse.Namespace) -> int:
    import os
    import time

    from cloudrc.drivers.keyfile import read_keys
    from cloudrc.tunnel.keys import KEY_SIZE, OVERLAP, Key, KeySet

    path: Path = options.file
    exists, secret = path.exists(), os.urandom(KEY_SIZE)
    if not exists and options.overlap is not None:
        raise BadInputError(f"--overlap: {path} does not exist, so there is no old key to keep")
    if not exists and options.drop:
        raise BadInputError(f"--drop: {path} does not exist, so there is no old key to revoke")
    if exists:
        keys, wall = read_keys(path, "", REMEDY), time.time()
        if not options.drop:
            _refuse_early_rotation(path, keys, wall)
        keys = keys.rotated(secret, wall, options.overlap or OVERLAP)
    else:
        keys = KeySet(Key(secret))
    _replace(path, keys)
    before = f", beside {keys.previous.name} for {keys.overlap:g} s" if keys.previous else ""
    print_line(f"key {keys.current.name}{before}: {path}")
    return 0


def _refuse_early_rotation(path: Path, keys: KeySet, wall: float) -> None:
    """Refuse to replace an old key that is still valid: an end may know only that key."""
    import math

    if keys.previous is not None and keys.until is not None and wall < keys.until:
        left = math.ceil(keys.until - wall)
        raise BadInputError(
            f"{path}: the old key {keys.previous.name} is valid for {left} s more; wait, "
            "or revoke it at once: cloudrc key new FILE --drop"
        )


def _retire(path: Path) -> int:
    from cloudrc.drivers.keyfile import read_keys
    from cloudrc.tunnel.keys import KeySet

    keys = read_keys(path, "", REMEDY)
    if keys.previous is None:
        print_line(f"key {keys.current.name} is the only key already: {path}")
        return 0
    _replace(path, KeySet(keys.current))
    print_line(
        f"key {keys.current.name} is the only key now, {keys.previous.name} is removed: {path}"
    )
    return 0


def _replace(path: Path, keys: KeySet) -> None:
    """Write keys to the target of a link, which a process may read by its own name."""
    import os

    from cloudrc.drivers.epochs import replace_durably
    from cloudrc.tunnel.keys import write

    try:
        replace_durably(Path(os.path.realpath(path)), write(keys).encode("ascii"))
    except OSError as error:
        remedy = "name a file in an existing, writable folder"
        raise BadInputError(f"{path}: {error.strerror or error}; {remedy}") from None


def _seconds(text: str) -> float:
    from cloudrc.tunnel.keys import OVERLAP_MAX

    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 < seconds <= OVERLAP_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not above 0 and at most {OVERLAP_MAX:g} s")
    return seconds
