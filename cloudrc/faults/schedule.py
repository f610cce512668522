"""What befalls one flight: a list of faults, each with its time, that a YAML file can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott

KINDS: dict[str, str] = {
    "blackout": "no datagram passes",
    "delay": "one-way delay rises by value [s]",
    "jitter": "jitter rises to value [s]",
    "loss": "a share of value is lost",
    "bursts": "loss in bursts of value packets",
    "corruption": "a share of value has a bit turned over",
    "garbage": "value datagrams of garbage before every honest one",
    "replay": "value captured datagrams before every honest one",
    "cloud_killed": "the cloud process is away",
    "pod_killed": "the cloud pod, teleop with it, is away",
    "teleop_killed": "teleop is away",
    "cloud_paused": "the cloud process stands still",
    "cloud_throttled": "the cloud process runs for a share of value of each 100 ms",
    "world_paused": "the world process stands still",
    "world_killed": "the world restarts",
    "journal_full": "the journal refuses every entry",
    "second_cloud": "another cloud with the same key joins",
    "key_rotated": "world reads a new key, cloud after the duration",
    "second_order": "another mission is ordered",
    "held": "the operator holds the mission, resumes it after the duration",
}
"""Every kind of fault."""
WAYS = ("both", "up", "down")


@dataclass(frozen=True, slots=True)
class Event:
    """One fault.

    Attributes:
        kind: One of `KINDS`.
        at: When it begins [s].
        duration: How long it lasts [s].
        value: How bad it is, as `KINDS` says [any unit].
        way: Of the link: "both", "up" or "down".
    """

    kind: str
    at: float
    duration: float = 0.0
    value: float = 0.0
    way: str = "both"

    @property
    def end(self) -> float:
        """When it is over [s]."""
        return self.at + self.duration


@dataclass(frozen=True, slots=True)
class Schedule:
    """All that befalls one flight.

    Attributes:
        seed: Of the link, and of everything random in the faults.
        profile: Of the link.
        events: In any order.
        duplicate: Share of datagrams that arrive twice, in [0, 1].
        reorder: Share of datagrams that overtake others, in [0, 1].
        cloud_offset: Cloud's clock minus world's [s]; 0 for one shared clock.
        cloud_drift: How fast cloud's clock is [ppm], a whole number.
        policy: Of an adversary in the place of cloud; "" for an honest cloud.
        duration: Of the flight [s].
    """

    seed: int
    profile: str = "paper-p2"
    events: tuple[Event, ...] = ()
    duplicate: float = 0.0
    reorder: float = 0.0
    cloud_offset: float = 0.0
    cloud_drift: int = 0
    policy: str = ""
    duration: float = 60.0

    @property
    def quiet_from(self) -> float:
        """When the last fault is over [s]."""
        return max((event.end for event in self.events), default=0.0)

    def of(self, *kinds: str) -> list[Event]:
        """List the faults of some kinds, by time."""
        return sorted((e for e in self.events if e.kind in kinds), key=lambda e: e.at)


LinkEvents: TypeAlias = list[Event]


def shaped(schedule: Schedule, profile: DirectionProfile, way: str) -> DirectionProfile:
    """Put a schedule's faults of the link over the conditions of one direction."""
    mine = [event for event in schedule.events if event.way in ("both", way)]
    blackouts = [Blackout(e.at, e.duration) for e in mine if e.kind == "blackout"]
    waves = [e for e in mine if e.kind in ("delay", "jitter", "loss", "bursts")]
    edges = sorted({instant for event in waves for instant in (event.at, event.end)})
    changes = tuple(_change(profile, [e for e in waves if e.at <= t < e.end], t) for t in edges)
    return replace(
        profile,
        blackouts=(*profile.blackouts, *blackouts),
        changes=(*profile.changes, *changes) if not profile.changes else profile.changes,
        duplicate=max(profile.duplicate, schedule.duplicate),
        reorder=max(profile.reorder, schedule.reorder),
    )


def _change(profile: DirectionProfile, active: LinkEvents, at: float) -> Change:
    """The conditions from an instant on, with all that is going on then."""
    delay, jitter, loss = profile.delay, profile.jitter, profile.loss
    for event in active:
        if event.kind == "delay":
            delay += event.value
        elif event.kind == "jitter":
            jitter = max(jitter, event.value)
        elif event.kind == "loss":
            loss = event.value
        else:
            loss = GilbertElliott(bad_start=0.01, bad_end=1.0 / max(event.value, 1.0))
    return Change(at, delay=delay, jitter=jitter, loss=loss)


def dump(schedule: Schedule, note: str = "") -> str:
    """Write a schedule as YAML, with a note of what it showed."""
    document: dict[str, Any] = {
        name: value
        for name, value in asdict(schedule).items()
        if name not in ("events",) and value != getattr(Schedule(0), name)
    }
    document["seed"] = schedule.seed
    document["events"] = [
        {name: value for name, value in asdict(event).items() if value or name == "at"}
        for event in sorted(schedule.events, key=lambda event: event.at)
    ]
    head = "".join(f"# {line}\n" for line in note.splitlines())
    text: str = yaml.safe_dump(document, sort_keys=False, width=100)
    return head + text


def load(path: Path) -> Schedule:
    """Read a schedule.

    Raises:
        BadInputError: If it is none.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        events = tuple(_event(each) for each in document.pop("events", ()))
        return Schedule(events=events, **document)
    except (OSError, yaml.YAMLError, TypeError, ValueError, AttributeError) as error:
        text = " ".join(str(error).split())
        raise BadInputError(f"{path}: is no schedule of faults: {text}") from error


def _event(values: Mapping[str, Any]) -> Event:
    event = Event(**values)
    if event.kind not in KINDS or event.way not in WAYS:
        raise ValueError(f"no fault '{event.kind}', way '{event.way}'")
    return event
