# SPDX-License-Identifier: Apache-2.0

"""`cloudrc key`: make or rotate the tunnel's pre-shared key."""

from __future__ import annotations

from pathlib import Path

from cloudrc.doors.cli.output import print_line
from cloudrc.doors.cli.parser import Options, Parser, add_verbs

VERBS = {
    "new": "make a key file, or rotate the key in one",
    "drop": "remove the old key of a rotation",
}
EPILOG = """\
World and cloud read the same key file ('--key FILE'; in a cluster, a Secret)
and read it again when it changes. 'new' on an existing file rotates the key:
the file keeps the old key as the second one, and each end accepts both. The
session changes to the new key, with one short HOLD in flight, once both ends
have read the file. 'drop' removes the second key: each end refuses it within a
second. Use 'drop', or the next 'new', only once both ends have reported the
new key; in a cluster that takes up to two minutes. In a cluster, run after
each of them:
  kubectl create secret generic NAME --from-file=key=FILE \\
    --dry-run=client -o yaml | kubectl apply -f -"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    new, drop = add_verbs(parser, VERBS).values()
    new.add_argument("file", type=Path, metavar="FILE", help="key file to write, with mode 0600")
    drop.add_argument("file", type=Path, metavar="FILE", help="key file made by 'new'")


def execute(options: Options) -> None:
    """Run `key new` (make or rotate a key) or `key drop` (remove the previous key)."""
    from cloudrc.flight.pod.keyfile import drop_previous, make_or_rotate

    path = options.file
    if options.verb == "new":
        keys = make_or_rotate(path)
        said = f", beside {keys.previous.name} until 'cloudrc key drop'" if keys.previous else ""
    else:
        keys, said = drop_previous(path), " is the only key"
    print_line(f"key {keys.current.name}{said}: {path}")
