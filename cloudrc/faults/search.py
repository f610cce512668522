"""Searches for schedules that break an invariant, for a budget of time; shrinks and stores them.

The seeds are consecutive numbers: a search that ended before seed N continues with `--first N`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc import __version__
from cloudrc.faults.adversary import choose
from cloudrc.faults.invariants import Breach
from cloudrc.faults.report import INVARIANTS
from cloudrc.faults.schedule import Event, Schedule, compose, dump
from cloudrc.faults.trial import Finding, checked_in, fly

KINDS: dict[str, Callable[[int], Schedule]] = {"random": compose, "adversarial": choose}
"""Kinds of searches: random faults, and hostile clouds with or without random faults."""
CHUNK = 500
"""Number of seeds that are handed to the pool at once."""
SHRINK_MAX = 120.0
"""Longest time to shrink one schedule [s]."""

Job: TypeAlias = tuple[str, int]
Map: TypeAlias = Callable[[Callable[[Job], Finding], Sequence[Job], int], Iterator[Finding]]
"""Calls a function on each job in several processes; yields the results in order."""


def fly_seed(job: Job) -> Finding:
    """Fly the schedule of a kind and a seed."""
    kind, seed = job
    return fly(KINDS[kind](seed))


class Search:
    """A search and its result so far.

    Attributes:
        kind: One of `KINDS`.
        first: First seed.
        next: Seed after the last one that was flown.
        failures: Schedules that broke an invariant, shrunk, as plain values.
    """

    def __init__(self, kind: str, first: int, store: Path) -> None:
        """Prepare a search.

        Args:
            kind: One of `KINDS`.
            first: First seed.
            store: Folder for failing schedules; it is made when needed.
        """
        self.kind, self.first, self.next, self._store = kind, first, first, store
        self.failures: list[dict[str, Any]] = []
        self._checked: Counter[str] = Counter()
        self._broken: Counter[str] = Counter()
        self._margin, self._speed, self._flown, self._seconds = 9.0, 0.0, 0.0, 0.0
        self._holds = self._missions = 0

    def run(
        self, minutes: float, call: Map, jobs: int = 1
    ) -> Generator[dict[str, Any] | None, None, None]:
        """Fly seed after seed until the time is over; at least one.

        Args:
            minutes: Budget of time [min].
            call: Calls a function in several processes.
            jobs: Number of processes.

        Yields:
            After each flight, what was stored if it failed, else None.
        """
        began = time.monotonic()
        for finding in self._findings(call, jobs):
            failure = self._take(finding)
            self._seconds = time.monotonic() - began
            yield failure
            if self._seconds >= 60.0 * minutes:
                return

    def document(self) -> dict[str, Any]:
        """Return the result so far as plain values."""
        return {
            "schemaVersion": 1,
            "kind": self.kind,
            "first": self.first,
            "next": self.next,
            "count": self.next - self.first,
            "version": __version__,
            "hours": self._flown / 3600.0,
            "seconds": self._seconds,
            "invariants": {
                name: {"judged": self._checked[name], "broken": self._broken[name]}
                for name in INVARIANTS
            },
            "smallest_margin_m": self._margin,
            "largest_speed_mps": self._speed,
            "holds": self._holds,
            "missions_done": self._missions,
            "failures": self.failures,
        }

    def _findings(self, call: Map, jobs: int) -> Iterator[Finding]:
        while True:
            yield from call(fly_seed, [(self.kind, self.next + n) for n in range(CHUNK)], jobs)

    def _take(self, finding: Finding) -> dict[str, Any] | None:
        self.next += 1
        self._checked.update(checked_in(finding.schedule))
        self._broken.update(finding.kinds)
        self._margin = min(self._margin, finding.margin)
        self._speed = max(self._speed, finding.speed)
        self._flown += finding.schedule.duration
        self._holds += finding.holds
        self._missions += finding.missions
        if not finding.breaches:
            return None
        self.failures.append(self._keep(finding))
        return self.failures[-1]

    def _keep(self, finding: Finding) -> dict[str, Any]:
        """Shrink and store a failing schedule."""
        kinds, until = finding.kinds, time.monotonic() + SHRINK_MAX

        def fails(schedule: Schedule) -> bool:
            return time.monotonic() < until and bool(fly(schedule).kinds & kinds)

        smallest = shrink(finding.schedule, fails)
        self._store.mkdir(parents=True, exist_ok=True)
        name = f"{'-'.join(sorted(kinds))}-{smallest.policy or 'seed'}-{smallest.seed}.yaml"
        path = self._store / name
        path.write_text(dump(smallest, _note(finding.schedule.seed, finding.breaches)), "utf-8")
        return {
            "seed": finding.schedule.seed,
            "breaches": [breach._asdict() for breach in finding.breaches],
            "schedule": asdict(smallest),
            "file": str(path),
        }


def _note(seed: int, breaches: Iterable[Breach]) -> str:
    lines = [f"{each.time:.3f} s: {each.kind}: {each.text}" for each in breaches]
    return "\n".join([f"Found by seed {seed}, before it was shrunk:", *lines[:3]])


Fails: TypeAlias = Callable[[Schedule], bool]
"""Tells whether a schedule fails in the same way."""


def shrink(schedule: Schedule, fails: Fails) -> Schedule:
    """Remove faults from a failing schedule, then simplify the rest, while it still fails.

    Source: A. Zeller, R. Hildebrandt, Simplifying and isolating failure-inducing input, IEEE TSE
    28(2), 2002: ddmin, on the list of faults.
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
    """Yield schedules with one thing less."""
    plain = Schedule(schedule.seed)
    for name in ("duplicate", "reorder", "cloud_offset", "cloud_drift", "profile", "separate",
                 "hold_max"):  # fmt: skip
        yield replace(schedule, **{name: getattr(plain, name)})
    for n, event in enumerate(schedule.events):
        shorter = replace(event, duration=round(event.duration / 2, 2))
        if shorter.duration > 0.0:
            events = list(schedule.events)
            events[n] = shorter
            yield replace(schedule, events=tuple(events))
