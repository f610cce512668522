"""What befalls one flight: a list of faults, each with its time, that a YAML file can hold.

A random schedule: a seed goes in, faults of every kind for one minute come out.

A failing schedule goes in, the smallest one that fails in the same way comes out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError

from cloudrc.errors import BadInputError, to_one_line
from cloudrc.faults.scenario import generator
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
    "teleop_shut_down": "teleop is asked to end, and away after a share of value of the duration",
    "pod_shut_down": "the cloud pod is asked to end, and away after a share of value",
    "cloud_paused": "the cloud process stands still",
    "cloud_throttled": "the cloud process runs for a share of value of each 100 ms",
    "world_paused": "the world process stands still",
    "world_killed": "the world restarts",
    "world_throttled": "the world process runs for a share of value of each 100 ms",
    "wall_clock": "the wall clock of both ends steps by value [s], for those that start later",
    "journal_full": "the journal refuses every entry",
    "journal_slow": "every fsync of the journal takes value [s]",
    "teleop_paused": "the teleop process stands still",
    "journal_torn": "the cloud pod is away, its journal has lost its last value bytes",
    "journal_rotten": "the cloud pod is away, a bit of its journal is wrong, at a share of value",
    "api_flood": "value requests to teleop in every 100 ms",
    "recorder_full": "world's recording has room for value bytes more",
    "recorder_slow": "every fsync of world's recording takes value [s]",
    "recorder_killed": "world's recorder is killed at the end",
    "power_cut": "world's disk forgets at the end, by chance, what was not synced",
    "names_lost": "no peer's name is resolved, after a share of value the peer moves",
    "second_cloud": "another cloud with the same key joins",
    "key_rotated": "world reads a new key, cloud after the duration",
    "key_wrong": "cloud reads a wrong key, that before stays valid for value [s]",
    "values_invalid": "value commands a second of an honest cloud hold NaN or infinity",
    "values_huge": "value commands a second of an honest cloud are 1e308 m/s",
    "second_order": "another mission is ordered",
    "stopped": "the operator stops the rotors, and acknowledges that some time after",
    "held": "the operator holds the mission, resumes it after the duration",
}
"""Every kind of fault."""
STALLS = ("journal_slow", "teleop_paused")
"""Kinds in which teleop is a process of its own, whatever the schedule says."""
WAYS = ("both", "up", "down")
SHARES = (
    *("loss", "corruption", "cloud_throttled", "world_throttled", "journal_rotten"),
    *("teleop_shut_down", "pod_shut_down", "names_lost"),
)
"""Kinds whose value is a share, in [0, 1]."""
VALUE_MAX = 1e9
WALL_MAX = 4e9
"""Of a step of the wall clock, both ways [s]: beyond both ends of what 32 bits count."""
DURATION_MAX = 86_400.0
"""Of a flight, and of everything in it [s]."""
OFFSET_MAX = 1e6
"""Between the two clocks [s]."""
_CONFIG = ConfigDict(extra="forbid")


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

    __pydantic_config__: ClassVar[ConfigDict] = _CONFIG
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
        apart: Whether teleop is a process of its own, as in production.
        hold_max: HOLD for so long in a mission ends in LAND [s].
    """

    __pydantic_config__: ClassVar[ConfigDict] = _CONFIG
    seed: int
    profile: str = "paper-p2"
    events: tuple[Event, ...] = ()
    duplicate: float = 0.0
    reorder: float = 0.0
    cloud_offset: float = 0.0
    cloud_drift: int = 0
    policy: str = ""
    duration: float = 60.0
    apart: bool = False
    hold_max: float = 60.0

    @property
    def has_teleop_apart(self) -> bool:
        """Whether teleop is a process of its own: it is, or some of its faults take it."""
        return self.apart or bool(self.of(*STALLS))

    @property
    def quiet_from(self) -> float:
        """When the last fault is over [s]."""
        return max((event.end for event in self.events), default=0.0)

    def of(self, *kinds: str) -> list[Event]:
        """List the faults of some kinds, by time."""
        return sorted((e for e in self.events if e.kind in kinds), key=lambda e: e.at)


def shaped(schedule: Schedule, profile: DirectionProfile, way: str) -> DirectionProfile:
    """Put a schedule's faults of the link over the conditions of one direction.

    Raises:
        BadInputError: If those change by themselves, and by a fault, too.
    """
    mine = [event for event in schedule.events if event.way in ("both", way)]
    blackouts = [Blackout(e.at, e.duration) for e in mine if e.kind == "blackout"]
    waves = [e for e in mine if e.kind in ("delay", "jitter", "loss", "bursts")]
    if waves and (profile.changes or profile.trace is not None):
        raise BadInputError(
            f"the link's profile {schedule.profile} has a time line, on which {waves[0].kind} "
            "cannot be laid; choose a profile that does not change"
        )
    edges = sorted({instant for event in waves for instant in (event.at, event.end)})
    changes = tuple(_change(profile, [e for e in waves if e.at <= t < e.end], t) for t in edges)
    return replace(
        profile,
        blackouts=(*profile.blackouts, *blackouts),
        changes=changes or profile.changes,
        duplicate=max(profile.duplicate, schedule.duplicate),
        reorder=max(profile.reorder, schedule.reorder),
    )


def _change(profile: DirectionProfile, active: list[Event], at: float) -> Change:
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
        if name != "events" and value != getattr(Schedule(0), name)
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
        BadInputError: If it is none, or nothing that could be flown.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise _none(path, "it has no keys")
        schedule = _SCHEDULE.validate_python(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise _none(path, f"{place}: {first['msg']}" if place else first["msg"]) from error
    except (OSError, yaml.YAMLError, ValueError, RecursionError) as error:
        text = getattr(error, "strerror", None) or to_one_line(str(error))
        raise _none(path, text) from error
    if problem := _problem(schedule):
        raise _none(path, problem)
    return schedule


_SCHEDULE = TypeAdapter(Schedule)


def _none(path: Path, text: str) -> BadInputError:
    return BadInputError(f"{path}: is no schedule of faults: {text}")


def _problem(schedule: Schedule) -> str:
    """What cannot be flown, in words; "" if all can."""
    numbers = {
        "seed": (schedule.seed, 0, 2**63),
        "duration": (schedule.duration, 0.1, DURATION_MAX),
        "duplicate": (schedule.duplicate, 0.0, 1.0),
        "reorder": (schedule.reorder, 0.0, 1.0),
        "cloud_offset": (schedule.cloud_offset, -OFFSET_MAX, OFFSET_MAX),
        "cloud_drift": (schedule.cloud_drift, -100_000, 100_000),
        "hold_max": (schedule.hold_max, 0.1, 3600.0),
    }
    for n, event in enumerate(schedule.events):
        if event.kind not in KINDS:
            return f"events.{n}.kind: no fault '{event.kind}'; there are: {', '.join(KINDS)}"
        if event.way not in WAYS:
            return f"events.{n}.way: '{event.way}' is none of {', '.join(WAYS)}"
        numbers[f"events.{n}.at"] = (event.at, 0.0, DURATION_MAX)
        numbers[f"events.{n}.duration"] = (event.duration, 0.0, DURATION_MAX)
        numbers[f"events.{n}.value"] = (event.value, *_range(event.kind))
    for place, (value, low, high) in numbers.items():
        if not low <= value <= high:  # NaN is not, either
            return f"{place}: {value:g} is not between {low:g} and {high:g}"
    return ""


def _range(kind: str) -> tuple[float, float]:
    """Lowest and highest value of a kind of fault."""
    if kind == "wall_clock":
        return -WALL_MAX, WALL_MAX
    return 0.0, 1.0 if kind in SHARES else VALUE_MAX


CALM = 45.0
"""From here on nothing new happens: the robot has to find back [s]."""
DURATION = 60.0
"""Of a flight [s]."""
PROFILES = ("ideal", "wifi", "lte", "5g", "lossy", "paper-p1", "paper-p2", "paper-p3")
PAPER = PROFILES[-3:]
HOLDS = 0.8, 3.0
"""Shortest and longest HOLD that is drawn [s]: 0.75 s are needed to fly on, at the default age."""
HOLD_MAX = Schedule(0).hold_max
ONCE = ("second_cloud", "key_rotated")
"""Kinds that happen at most once in a flight."""

# Kind -> longest duration [s], lowest and highest value.
RANGES: dict[str, tuple[float, float, float]] = {
    "blackout": (8.0, 0.0, 0.0),
    "delay": (10.0, 0.01, 0.3),
    "jitter": (10.0, 0.01, 0.15),
    "loss": (10.0, 0.05, 0.9),
    "bursts": (15.0, 3.0, 60.0),
    "corruption": (10.0, 0.01, 1.0),
    "garbage": (5.0, 1.0, 20.0),
    "replay": (5.0, 1.0, 20.0),
    "cloud_killed": (5.0, 0.0, 0.0),
    "pod_killed": (8.0, 0.0, 0.0),
    "teleop_killed": (6.0, 0.0, 0.0),
    "teleop_shut_down": (6.0, 0.0, 1.0),
    "pod_shut_down": (8.0, 0.0, 1.0),
    "cloud_paused": (5.0, 0.0, 0.0),
    "cloud_throttled": (8.0, 0.05, 0.9),
    "world_paused": (1.0, 0.0, 0.0),
    "world_killed": (3.0, 0.0, 0.0),
    "world_throttled": (8.0, 0.1, 0.95),
    "wall_clock": (0.0, -WALL_MAX, WALL_MAX),
    "journal_full": (10.0, 0.0, 0.0),
    "journal_slow": (10.0, 0.05, 3.0),
    "teleop_paused": (5.0, 0.0, 0.0),
    "journal_torn": (8.0, 1.0, 60.0),
    "journal_rotten": (8.0, 0.0, 1.0),
    "api_flood": (5.0, 10.0, 64.0),
    "recorder_full": (10.0, 0.0, 60_000.0),  # 14 kB at once, 33 kB/s then: two in three are full
    "recorder_slow": (10.0, 0.1, 5.0),
    "recorder_killed": (10.0, 0.0, 0.0),
    "power_cut": (10.0, 0.0, 0.0),
    "names_lost": (10.0, 0.0, 1.0),
    "second_cloud": (15.0, 0.0, 0.0),
    "key_rotated": (10.0, 0.0, 0.0),
    "key_wrong": (10.0, 0.001, 3.0),
    "values_invalid": (10.0, 1.0, 12.0),
    "values_huge": (10.0, 1.0, 4.0),
    "second_order": (0.0, 0.0, 0.0),
    "stopped": (0.0, 0.0, 0.0),
    "held": (5.0, 0.0, 0.0),
}


def compose(seed: int) -> Schedule:
    """Make the schedule of a seed: 1 to 12 faults within 45 s, then 15 s of calm."""
    rng = generator(seed, 40)
    events: list[Event] = []
    kinds = sorted(KINDS)
    for _ in range(int(rng.integers(1, 13))):
        kind = kinds[int(rng.integers(len(kinds)))]
        if kind not in ONCE or all(event.kind != kind for event in events):
            events.append(_event(kind, rng))
    if rng.random() < 0.3:
        events += _swizzle(rng)
    return Schedule(
        seed,
        PROFILES[int(rng.integers(len(PROFILES)))],
        tuple(sorted(events, key=lambda event: event.at)),
        duplicate=_sometimes(rng, 1.0),
        reorder=_sometimes(rng, 0.5),
        cloud_offset=round(float(rng.uniform(-1e5, 1e5)), 3) if rng.random() < 0.5 else 0.0,
        cloud_drift=int(rng.integers(-500, 501)) if rng.random() < 0.3 else 0,
        duration=DURATION,
        apart=bool(rng.random() < 0.5),
        # In every third schedule shorter than many a silence: the robot lands amid other faults.
        hold_max=round(float(rng.uniform(*HOLDS)), 1) if rng.random() < 1 / 3 else HOLD_MAX,
    )


def calm(seed: int) -> Schedule:
    """Make a flight in which nothing goes wrong, on one of the paper's three links."""
    return Schedule(seed, PAPER[seed % len(PAPER)], duration=DURATION)


def _event(kind: str, rng: np.random.Generator) -> Event:
    longest, low, high = RANGES[kind]
    at = float(rng.uniform(0.5, CALM - 1.0))
    # As many short ones as long ones: 20 ms are as good at finding something as 5 s.
    duration = longest * float(rng.uniform()) ** 3 if longest else 0.0
    way = WAYS[int(rng.integers(3))]
    value = float(rng.uniform(low, high))
    end = min(at + max(duration, 0.02), CALM)
    return Event(kind, round(at, 3), round(end - at, 3) if longest else 0.0, round(value, 4), way)


def _swizzle(rng: np.random.Generator) -> list[Event]:
    """Freeze everything one by one, let it go in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    things = [("blackout", "up"), ("blackout", "down"), ("cloud_paused", "both")]
    things.append(("world_paused", "both"))
    starts = float(rng.uniform(1.0, 35.0)) + np.cumsum(rng.uniform(0.05, 0.8, 4))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.05, 1.0, 4)))
    return [
        Event(kind, round(float(a), 3), round(float(b - a), 3), 0.0, way)
        for (kind, way), a, b in zip(things, starts, ends, strict=True)
    ]


def _sometimes(rng: np.random.Generator, most: float) -> float:
    return round(float(rng.uniform(0.0, most)), 3) if rng.random() < 0.25 else 0.0


Fails = Callable[[Schedule], bool]


def shrink(schedule: Schedule, fails: Fails) -> Schedule:
    """Take out faults, then simplify what is left, as long as it still fails.

    Source: A. Zeller, R. Hildebrandt, Simplifying and isolating failure-inducing input, IEEE TSE
    28(2), 2002: ddmin, on the list of faults.

    Args:
        schedule: That fails.
        fails: Whether a schedule fails in the same way.
    """
    schedule = replace(schedule, events=_ddmin(schedule, fails))
    changed = True
    while changed:
        changed = False
        for simpler in _simpler(schedule):
            if simpler != schedule and fails(simpler):
                schedule, changed = simpler, True
                break
    return schedule


def _ddmin(schedule: Schedule, fails: Fails) -> tuple[Event, ...]:
    events, parts = schedule.events, 2
    while len(events) >= 2:
        size = -(-len(events) // parts)
        rests = [events[:at] + events[at + size :] for at in range(0, len(events), size)]
        rest = next((r for r in rests if fails(replace(schedule, events=r))), None)
        if rest is not None:
            events, parts = rest, max(parts - 1, 2)
        elif size == 1:
            break
        else:
            parts = min(2 * parts, len(events))
    return events


def _simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules with one thing less."""
    plain = Schedule(schedule.seed)
    for name in ("duplicate", "reorder", "cloud_offset", "cloud_drift", "profile", "apart",
                 "hold_max"):  # fmt: skip
        yield replace(schedule, **{name: getattr(plain, name)})
    if not schedule.events:
        return
    if len(schedule.events) == 1:
        yield replace(schedule, events=())
    for n, event in enumerate(schedule.events):
        for shorter in (round(event.duration / 2, 2), round(event.duration, 1)):
            if 0.0 < shorter < event.duration:
                yield _with(schedule, n, replace(event, duration=shorter))
        if event.way == "both":
            yield _with(schedule, n, replace(event, way="up"))
            yield _with(schedule, n, replace(event, way="down"))
        if round(event.at, 1) != event.at:
            yield _with(schedule, n, replace(event, at=round(event.at, 1)))


def _with(schedule: Schedule, n: int, event: Event) -> Schedule:
    events = schedule.events
    return replace(schedule, events=(*events[:n], event, *events[n + 1 :]))
