# SPDX-License-Identifier: Apache-2.0

"""Change the link of a run that flies on this machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cloudrc.base.errors import RejectedError, StateError, TimedOutError
from cloudrc.base.outside.document import Document, write_yaml
from cloudrc.base.text import table
from cloudrc.config.link_edit import Edit, edit_profile
from cloudrc.config.profile import DIRECTIONS
from cloudrc.flight.local.places import link_socket
from cloudrc.flight.pod.link_control import ask
from cloudrc.link.control import APPLY_LIMIT, put_request
from cloudrc.link.follow import PROFILE
from cloudrc.link.state import (
    CHANGE_FILE,
    STATE_FILE,
    ChangeFacts,
    LinkState,
    from_text,
    write_change,
)

COLUMNS = ("delay_ms", "jitter_ms", "distribution", "loss", "rate_kbit")
"""Keys of a direction that have columns of their own; the column OTHER shows all other keys."""


def read_states(folder: Path) -> list[LinkState]:
    """Read the states of both directions from the link's folder; [] while there is no link."""
    try:
        return [from_text((folder / way / STATE_FILE).read_text("utf-8")) for way in DIRECTIONS]
    except (OSError, ValueError):
        return []


def set_here(
    folder: Path, url: str, profile: str | None, settings: Sequence[str], number: str
) -> tuple[Edit, list[LinkState]]:
    """Send a profile to a local link; wait until it applies; return the profile and the new states.

    `folder` is the link's folder, and `url` the address of the run's API. `profile` is the name or
    file of a profile that replaces the present one; None keeps it. `settings` are texts such as
    "uplink.delay_ms=120". `number` identifies the change.

    Raises:
        StateError: If there is no link yet.
        RejectedError: If a direction does not take the change.
        TimedOutError: If a direction does not apply the change.
    """
    states = read_states(folder)
    if not states:
        raise StateError(
            f"{folder.parent}: no link is up there: the flight has not begun or has ended"
        )
    edit = edit_profile(Document(states[0].profile), profile, settings)
    note = write_change(ChangeFacts(number, edit.cause, edit.restart))
    request = put_request(json.dumps({CHANGE_FILE: note, PROFILE: write_yaml(edit.values)}))
    return edit, [_change(folder, way, url, request, number) for way in DIRECTIONS]


def _change(folder: Path, way: str, url: str, request: bytes, number: str) -> LinkState:
    """Change one direction of a link; return its new state."""
    log = folder.parent / f"{way}.log"
    try:
        state = ask(link_socket(url, way), request)
    except (OSError, ValueError) as error:
        raise TimedOutError(f"the {way} does not answer ({error}); see {log}") from None
    if why := state.objection(number):
        raise RejectedError(why)
    if state.change != number:
        text = f"the {way} did not apply the change within {APPLY_LIMIT:g} s"
        raise TimedOutError(f"{text}; see {log}")
    return state


def states_table(states: Sequence[LinkState]) -> str:
    """Return a table with a row per direction of a link."""
    heads = ("DIRECTION", "SHAPER", "DELAY", "JITTER", "LOSS", "RATE", "OTHER")
    return table([heads, *map(_row, states)])


def _row(state: LinkState) -> tuple[str, ...]:
    asked, own = state.asked, state.profile.get(state.direction, {})
    delay, jitter, loss, rate = (
        asked.get(key) or 0.0 for key in ("delay", "jitter", "loss", "rate")
    )
    others = (_describe(key, own[key]) for key in own if key not in COLUMNS)
    return (
        state.direction,
        state.shaper,
        f"{delay * 1e3:g} ms",
        f"{jitter * 1e3:g} ms" + (f" {own.get('distribution', 'uniform')}" if jitter else ""),
        f"{loss * 100:.3g} %",
        f"{rate * 1e-3:g} kbit/s" if rate else "-",
        ", ".join(others) or "-",
    )


def _describe(key: str, value: Any) -> str:
    if isinstance(value, list):
        return f"{len(value)} {key}"
    return f"{key} {Path(value).name if isinstance(value, str) else value}"
