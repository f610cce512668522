"""`cloudrc key`: make or rotate the tunnel's pre-shared key."""

from __future__ import annotations

import argparse
import os
import sys
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
the file keeps the key until now as the second, and each end accepts both. The
session changes to the new key, with one short HOLD in flight, once both ends
have read the file. 'drop' removes the second key: each end refuses it within a
second. Use 'drop', or the next 'new', only once both ends have reported the
new key; in a cluster that takes up to two minutes. In a cluster, run after
each of them:
  kubectl create secret generic NAME --from-file=key=FILE \\
    --dry-run=client -o yaml | kubectl apply -f -"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    new = verbs.add_parser("new", help="make a key file, or rotate the key in one")
    new.add_argument("file", type=Path, metavar="FILE", help="key file to write, with mode 0600")
    new.add_argument("--overlap", metavar="SECONDS", help="ignored: see 'drop'")
    new.add_argument("--drop", action="store_true", help="ignored: a second key is always replaced")
    drop = verbs.add_parser("drop", help="remove the old key of a rotation", aliases=["retire"])
    drop.add_argument("file", type=Path, metavar="FILE", help="key file made by 'new'")


def execute(options: argparse.Namespace) -> int:
    """Make a key, or drop the previous key."""
    return _make(options) if options.verb == "new" else _drop(options.file)


def _make(options: argparse.Namespace) -> int:
    from cloudrc.drivers.keyfile import read_keys
    from cloudrc.tunnel.keys import KEY_SIZE, Key, KeySet

    path: Path = options.file
    if options.overlap is not None:
        text = "--overlap is ignored: the old key is accepted until 'cloudrc key drop'"
        print(f"cloudrc: {text}", file=sys.stderr)
    old = read_keys(path, "", REMEDY).current if path.exists() else None
    keys = KeySet(Key(os.urandom(KEY_SIZE)), old)
    _replace(path, keys)
    beside = f", beside {old.name} until 'cloudrc key drop'" if old else ""
    print_line(f"key {keys.current.name}{beside}: {path}")
    return 0


def _drop(path: Path) -> int:
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
    """Write keys to a file; if the path is a symbolic link, write to the target of that link."""
    from cloudrc.files import write_atomically
    from cloudrc.tunnel.keys import write

    try:
        write_atomically(Path(os.path.realpath(path)), write(keys).encode("ascii"), 0o600)
    except OSError as error:
        remedy = "name a file in an existing, writable folder"
        raise BadInputError(f"{path}: {error.strerror or error}; {remedy}") from None
