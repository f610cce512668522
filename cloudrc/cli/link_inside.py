"""`cloudrc link set --inside`: in a link container, by `kubectl exec`, as `link set` asks for it.

What it reads from standard input is left where the container's sidecar looks; what that tells of
itself goes to standard output once it has taken the change over, or will not.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import monotonic, sleep

from cloudrc.errors import BadInputError
from cloudrc.link.route import publish
from cloudrc.link.sidecar_handed import HANDED_FILE, SIZE_MAX, read_handed
from cloudrc.link.state import STATE_FILE, LinkState, from_text, read_change

PATIENCE = 5.0
"""For the sidecar to take a change over [s]; it takes 0.2."""
_LOOK_PERIOD = 0.02


def execute(folder: Path) -> int:
    """Hand a change over, and tell what is in force then.

    Args:
        folder: Where route and state lie.

    Raises:
        BadInputError: If what is read is no change, or no sidecar is here.
    """
    text = sys.stdin.read(SIZE_MAX)
    try:
        handed = read_handed(text)
    except ValueError as error:
        raise BadInputError(f"--inside reads what 'cloudrc link set' writes: {error}") from error
    number, state = read_change(handed.change).number, folder / STATE_FILE
    try:
        publish(folder / HANDED_FILE, text)
        until = monotonic() + PATIENCE
        while not _is_decided(told := state.read_text(encoding="utf-8"), number):
            if monotonic() > until:
                break
            sleep(_LOOK_PERIOD)
    except OSError as error:
        raise BadInputError(f"no link is shaped here: {error}; see --context and -n") from error
    sys.stdout.write(told)
    return 0


def _is_decided(text: str, number: str) -> bool:
    try:
        state: LinkState = from_text(text)
    except ValueError:  # of another version
        return False
    return number in (state.change, state.refused)
