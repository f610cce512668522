"""Change the link of a run that flies on this machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, sleep

from cloudrc.config.document import Document, write_yaml
from cloudrc.config.load import DIRECTIONS, Edit, edit_profile
from cloudrc.errors import BadInputError, TimedOutError
from cloudrc.files import write_atomically
from cloudrc.link.follow import HANDED_FILE, PROFILE
from cloudrc.link.state import (
    CHANGE_FILE,
    STATE_FILE,
    ChangeFacts,
    LinkState,
    from_text,
    write_change,
)

LOCAL_TIMEOUT = 5.0
"""Time limit for a local link to apply a change [s]; it needs about 0.2 s."""


def read_states(folder: Path) -> list[LinkState]:
    """Read the states of both directions from the link's folder; [] while there is no link."""
    try:
        return [from_text((folder / way / STATE_FILE).read_text("utf-8")) for way in DIRECTIONS]
    except (OSError, ValueError):
        return []


def set_here(
    folder: Path, profile: str | None, settings: Sequence[str], number: str
) -> tuple[Edit, list[LinkState]]:
    """Pass a profile to a local link; wait until it applies; return the profile and the new states.

    `profile` is the name or file of a profile that replaces the present one; None keeps it.
    `settings` are texts such as "uplink.delay_ms=120". `number` identifies the change.

    Raises:
        BadInputError: If there is no link yet, or if a value cannot be used.
        TimedOutError: If a direction does not apply the change.
    """
    states = read_states(folder)
    if not states:
        raise BadInputError(
            f"{folder.parent}: no link is up there: the flight has not begun or has ended"
        )
    edit = edit_profile(Document(states[0].profile), profile, settings)
    note = write_change(ChangeFacts(number, edit.cause, edit.restart))
    document = json.dumps({CHANGE_FILE: note, PROFILE: write_yaml(edit.values)})
    for state in states:
        write_atomically(folder / state.direction / HANDED_FILE, document.encode())
    deadline = monotonic() + LOCAL_TIMEOUT
    while late := [state.direction for state in states if state.change != number]:
        if monotonic() > deadline:
            logs = " and ".join(str(folder.parent / f"{way}.log") for way in late)
            raise TimedOutError(
                f"the {' and '.join(late)} did not apply the change within {LOCAL_TIMEOUT:g} s; "
                f"see {logs}"
            )
        sleep(0.05)
        states = read_states(folder) or states
    return edit, states
