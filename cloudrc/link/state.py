# SPDX-License-Identifier: Apache-2.0

"""Publish the state of one direction of the link in a file: its shaper, profile and last change.

The state file is in the folder of the route file. World or cloud on the same machine reads it and
records each change; `cloudrc link set` reads in it whether a change has taken effect.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from cloudrc.base.files import write_atomically

STATE_FILE = "link.json"  # name of the state file, in the folder of the route file
STATE_MAX = 1 << 16
"""Size limit of a state file that world or cloud reads [bytes]: room for a schedule of about 800
changes. Reading a file of 1 MiB could block the control loop for 2 s."""
RELEASED_SUFFIX = ".released"
"""Suffix of the file in which a relay reports the lateness of datagrams: JSON, name -> integer."""
RELEASED = frozenset(
    {"released", "released_early", "overflow", "stalled"}
    | {f"release_error_{quantile}_ns" for quantile in ("p50", "p99", "p999")}
)
"""Names in the file with the suffix `RELEASED_SUFFIX`."""
CHANGE_FILE = "change.json"  # last `ChangeFacts` of a profile, in the profile's folder


@dataclass(frozen=True, slots=True)
class ChangeFacts:
    """Facts about a change of a link profile; `cloudrc link set` writes them to `CHANGE_FILE`.

    If `restart` is True, the profile's schedule starts again when the new profile takes effect.
    """

    number: str = ""  # identifies the change; "" if unknown
    cause: str = "the profile's file changed"  # why the profile was changed, in words
    restart: bool = True


@dataclass(frozen=True, slots=True)
class LinkState:
    """Shaper, profile and last change of one direction; times on the machine's monotonic clock."""

    shaper: str  # "relay" or "netem"
    reason: str  # why this shaper was chosen, in words
    mode: str  # requested shaper: "auto", "relay" or "netem"
    direction: str  # "uplink" or "downlink"
    profile: dict[str, Any]  # profiles of both directions, as in the file, without defaults
    since: str  # when the profile took effect, UTC, to show to users
    since_ns: int  # when the profile took effect [ns]
    changes: int = 0  # number of changes since the link came up
    change: str = ""  # number of the last change that took effect; "" if unknown
    cause: str = ""  # why the profile was changed, in words; "" before the first change
    asked: dict[str, float | None] = field(default_factory=dict)  # by `link.profile.summary`
    origin_ns: int = 0  # start of the schedule [ns]
    refused: str = ""  # number of the last refused change; "" if no change was refused
    refusal: str = ""  # why the last refused change was refused, in words

    def has_decided(self, number: str) -> bool:
        """Return whether the direction has taken or refused the change `number`."""
        return number in (self.change, self.refused)

    def objection(self, number: str) -> str:
        """Say why the change `number` was refused; "" if it was not."""
        return f"the {self.direction} is unchanged: {self.refusal}" * (self.refused == number)


def to_text(state: LinkState) -> str:
    """Format a state as JSON."""
    return json.dumps(asdict(state), indent=2) + "\n"


def publish(text: str, file: Path) -> None:
    """Write what a link tells to a file, if the disk is not full: the link works without it."""
    with suppress(OSError):
        write_atomically(file, text.encode())


def from_text(text: bytes | str) -> LinkState:
    """Parse the JSON text of a link's state; raise a ValueError if the text is invalid."""
    try:
        return LinkState(**json.loads(text))
    except TypeError as error:
        raise ValueError(f"not a LinkState: {error}") from None


def write_change(change: ChangeFacts) -> str:
    """Format a change as the content of change.json."""
    return json.dumps(asdict(change)) + "\n"


def read_change(text: str) -> ChangeFacts:
    """Parse the content of change.json; return an empty `ChangeFacts` if the text is invalid."""
    try:
        found = json.loads(text)
        return ChangeFacts(str(found["number"]), str(found["cause"]), bool(found["restart"]))
    except (ValueError, KeyError, TypeError):
        return ChangeFacts()
