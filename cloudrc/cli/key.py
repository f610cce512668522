"""`cloudrc key`: make the tunnel's pre-shared key, and rotate it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import say
from cloudrc.errors import BadInputError

REMEDY = "name a key file; 'cloudrc key new FILE' makes one where there is no file yet"

if TYPE_CHECKING:
    from cloudrc.tunnel.keys import KeySet

EPILOG = """\
Both ends of the tunnel read the same key file ('--key FILE', in the cluster
a Secret) and follow it while they fly. 'new' on a file that is there already
rotates: the old key stays valid beside the new one for the overlap, counted
by each process from the moment it reads the file, so that nothing is lost
while the file is on its way. A process that starts later accepts the old key
only until the instant that the file holds. A second 'new' within that time is
refused: an end that has not read the file yet would share no key with one that
has; wait, or revoke the old key at once with '--drop'. 'retire' takes the old
key out of the file: who follows it refuses that key within a second. A key that
has leaked: 'new', and 'retire' once both ends have read the file. In the
cluster, after each:
  kubectl create secret generic NAME --from-file=key=FILE \\
    --dry-run=client -o yaml | kubectl apply -f -"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    new = verbs.add_parser("new", help="make a key file, or rotate the key in one")
    new.add_argument("file", type=Path, metavar="FILE", help="gets mode 0600")
    new.add_argument(
        "--overlap",
        type=_seconds,
        default=None,
        metavar="SECONDS",
        help="how long the old key stays valid after a rotation (default: 300)",
    )
    new.add_argument(
        "--drop",
        action="store_true",
        help="revoke the old key of a rotation that is not over yet, at once",
    )
    retire = verbs.add_parser("retire", help="drop the old key of a rotation before its time")
    retire.add_argument("file", type=Path, metavar="FILE", help="made by 'new'")


def execute(options: argparse.Namespace) -> int:
    """Make the key, or leave one alone in its file."""
    return _retire(options.file) if options.verb == "retire" else _make(options)


def _make(options: argparse.Namespace) -> int:
    import os
    import time

    from cloudrc.drivers.keyfile import read_keys
    from cloudrc.tunnel.keys import KEY_SIZE, OVERLAP, Key, KeySet

    path: Path = options.file
    there, secret = path.exists(), os.urandom(KEY_SIZE)
    if not there and options.overlap is not None:
        raise BadInputError(f"--overlap: {path} is not there, so there is no old key to keep")
    if not there and options.drop:
        raise BadInputError(f"--drop: {path} is not there, so there is no old key to revoke")
    if there:
        keys, wall = read_keys(path, "", REMEDY), time.time()
        if not options.drop:
            _refuse_if_promised(path, keys, wall)
        keys = keys.rotated(secret, wall, options.overlap or OVERLAP)
    else:
        keys = KeySet(Key(secret))
    _replace(path, keys)
    before = f", beside {keys.previous.name} for {keys.overlap:g} s" if keys.previous else ""
    say(f"key {keys.current.name}{before}: {path}")
    return 0


def _refuse_if_promised(path: Path, keys: KeySet, wall: float) -> None:
    """A file has room for one old key: for whoever knows only that one, it stays its time."""
    import math

    if keys.previous is not None and keys.until is not None and wall < keys.until:
        left = math.ceil(keys.until - wall)
        raise BadInputError(
            f"{path}: key {keys.previous.name}, the one before, is valid for {left} s more; wait, "
            "or revoke it at once: cloudrc key new FILE --drop"
        )


def _retire(path: Path) -> int:
    from cloudrc.drivers.keyfile import read_keys
    from cloudrc.tunnel.keys import KeySet

    keys = read_keys(path, "", REMEDY)
    if keys.previous is None:
        say(f"key {keys.current.name} was alone already: {path}")
        return 0
    _replace(path, KeySet(keys.current))
    say(f"key {keys.current.name} alone, {keys.previous.name} is dropped: {path}")
    return 0


def _replace(path: Path, keys: KeySet) -> None:
    """Put them into the file that a link leads to: there is who follows it by another name."""
    import os

    from cloudrc.drivers.epochs import replace_durably
    from cloudrc.tunnel.keys import write

    try:
        replace_durably(Path(os.path.realpath(path)), write(keys).encode("ascii"))
    except OSError as error:
        remedy = "name a file in a folder that is there and that you may write in"
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
