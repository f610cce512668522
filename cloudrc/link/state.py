"""What a link tells of itself, in a file beside the route: who shapes it, how, since when and why.

The tunnel's end of the same machine follows it and records changes; `cloudrc link set` reads from
it that a change has taken force; reports show it.

Files of the shared folder that others read while they are written: whole, or not there.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from cloudrc.files import put
from cloudrc.link.profile import DirectionProfile, Timeline, mean_loss

STATE_FILE = "link.json"
"""Name of the file, beside the route."""
STATE_MAX = 1 << 16
"""Longest that an end of the tunnel reads of it [bytes]: some 800 changes of a time line. What is
wrong with a profile of 1 MiB takes 2 s to find, in which the loop would stand still."""
RELEASED_SUFFIX = ".released"
"""Of the file beside it that tells how late a relay's datagrams left so far: names and whole
numbers, as JSON. A file of its own, since the state is read only when the link changes."""
RELEASED = frozenset(
    {"released", "released_early", "overflow", "stalled"}
    | {f"release_error_{quantile}_ns" for quantile in ("p50", "p99", "p999")}
)
"""The names in it."""
CHANGE_FILE = "change.json"
"""Name of the file beside the profile that says who changed it and why."""


@dataclass(frozen=True, slots=True)
class Change:
    """Why a profile was changed, as `cloudrc link set` leaves it beside the profile.

    Attributes:
        number: Names this change; "" if nobody told.
        cause: In words.
        restart: Whether the profile's time line counts from when it takes force; else it goes on.
    """

    number: str = ""
    cause: str = "the profile's file changed"
    restart: bool = True


@dataclass(frozen=True, slots=True)
class LinkState:
    """What shapes one direction, and what it was asked for.

    Attributes:
        shaper: "relay" or "netem".
        reason: Why this one, in words.
        mode: What was asked for: "auto", "relay" or "netem".
        direction: "uplink" or "downlink".
        profile: Both directions, as in a profile's file, defaults left out.
        since: When that took force, UTC, for people.
        since_ns: The same on the machine's monotonic clock [ns].
        changes: How often it has changed since the link came up.
        change: Number of the last change that took force; "" if it had none.
        cause: Why it changed, in words; "" before the first change.
        asked: What holds at the beginning of its time line, as `summary` gives it.
        origin_ns: From when its time line counts, on that clock [ns]; None: as the one before.
        refused: Number of the last change that was refused; "" if none was.
        refusal: Why, in words.
    """

    shaper: str
    reason: str
    mode: str
    direction: str
    profile: dict[str, Any]
    since: str
    since_ns: int
    changes: int = 0
    change: str = ""
    cause: str = ""
    asked: dict[str, float | None] = field(default_factory=dict)
    origin_ns: int | None = None
    refused: str = ""
    refusal: str = ""


def to_text(state: LinkState) -> str:
    """Write a state as JSON."""
    return json.dumps(asdict(state), indent=2) + "\n"


def from_text(text: str) -> LinkState:
    """Read a state; raises a ValueError if the text is none."""
    found = json.loads(text)
    names = {one.name for one in fields(LinkState)}
    try:
        return LinkState(**{name: value for name, value in found.items() if name in names})
    except (TypeError, AttributeError) as error:
        raise ValueError(f"not the state of a link: {error}") from error


def read_change(text: str) -> Change:
    """Read why a profile was changed; what cannot be read is as if nobody had told."""
    try:
        found = json.loads(text)
        return Change(str(found["number"]), str(found["cause"]), bool(found["restart"]))
    except (ValueError, KeyError, TypeError):
        return Change()


def summary(profile: DirectionProfile) -> dict[str, float | None]:
    """Say in four numbers what a direction is asked to be at the beginning of its time line.

    Returns:
        `delay` and `jitter` [s], `loss` in the long run, in [0, 1], and `rate` [bit/s], None if
        there is no bottleneck.
    """
    first = Timeline(profile).at(0)
    loss = 1.0 if first.blackout else mean_loss(first.loss)
    delay = round(first.delay_ns * 1e-9, 9)
    return {"delay": delay, "jitter": first.jitter, "loss": loss, "rate": first.rate}


def publish(path: Path, text: str) -> None:
    """Write a file in one step, as far as its readers can see.

    Args:
        path: The file; its folder exists.
        text: What stands in it from now on.
    """
    put(path, text.encode("utf-8"))


def publish_route(path: Path, route: tuple[str, int]) -> None:
    """Tell this pod's tunnel end where it has to send: one line HOST:PORT."""
    publish(path, f"{route[0]}:{route[1]}\n")


def withdraw(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)
