"""Fly random schedules for some minutes to find breaches of invariants, and store them.

Seeds are consecutive numbers. To continue a search that ended before seed N, use `--first N`.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.faults.adversary import choose
from cloudrc.faults.schedule import Schedule, compose, dump
from cloudrc.faults.trial import INVARIANTS, Finding, checked_in, fly

KINDS: dict[str, Callable[[int], Schedule]] = {"random": compose, "adversarial": choose}
"""Kinds of search: random faults, and dishonest clouds with or without random faults."""
CHUNK = 500  # number of seeds that are handed to the pool at once

Job: TypeAlias = tuple[str, int]
Map: TypeAlias = Callable[[Callable[[Job], Finding], Sequence[Job], int], Iterator[Finding]]
"""Function that calls another function on each job in several processes, and keeps the order."""


def fly_seed(job: Job) -> Finding:
    """Fly one schedule of a search; `job` has the kind of the search and the seed."""
    kind, seed = job
    return fly(KINDS[kind](seed))


class Search:
    """A search and its result so far; `next` is the next seed."""

    def __init__(self, kind: str, first: int, store: Path) -> None:
        """Prepare a search from the seed `first` on; `kind` is a key of `KINDS`.

        The search writes schedules that break an invariant to the folder `store`.
        """
        self.kind, self.first, self.next, self._store = kind, first, first, store
        self.failures: list[dict[str, Any]] = []  # schedules that broke an invariant
        self._checked: Counter[str] = Counter()
        self._broken: Counter[str] = Counter()
        self._margin, self._speed, self._seconds, self._missions = 9.0, 0.0, 0.0, 0

    def run(
        self, minutes: float, call: Map, jobs: int = 1
    ) -> Generator[dict[str, Any] | None, None, None]:
        """Fly one flight per seed for `minutes` [min]; `call` runs them in `jobs` processes.

        Yields:
            After each flight: the stored failure, or None if no invariant was broken.
        """
        began = time.monotonic()
        while True:
            chunk = [(self.kind, self.next + n) for n in range(CHUNK)]
            for finding in call(fly_seed, chunk, jobs):
                failure = self._take(finding)
                self._seconds = time.monotonic() - began
                yield failure
                if self._seconds >= 60.0 * minutes:
                    return

    def document(self) -> dict[str, Any]:
        """Return the result so far as plain values, for JSON."""
        return {
            "kind": self.kind,
            "first": self.first,
            "next": self.next,
            "count": self.next - self.first,
            "seconds": self._seconds,
            "invariants": {
                name: {"judged": self._checked[name], "broken": self._broken[name]}
                for name in INVARIANTS
            },
            "smallest_margin_m": self._margin,
            "largest_speed_mps": self._speed,
            "missions_done": self._missions,
            "failures": self.failures,
        }

    def _take(self, finding: Finding) -> dict[str, Any] | None:
        self.next += 1
        self._checked.update(checked_in(finding.schedule))
        self._broken.update(finding.kinds)
        self._margin = min(self._margin, finding.margin)
        self._speed = max(self._speed, finding.speed)
        self._missions += finding.missions
        if not finding.breaches:
            return None
        self.failures.append(self._keep(finding))
        return self.failures[-1]

    def _keep(self, finding: Finding) -> dict[str, Any]:
        schedule, seed = finding.schedule, finding.schedule.seed
        name = f"{'-'.join(sorted(finding.kinds))}-{schedule.policy or 'seed'}-{seed}.yaml"
        lines = [f"{each.time:.3f} s: {each.kind}: {each.text}" for each in finding.breaches[:3]]
        self._store.mkdir(parents=True, exist_ok=True)
        (self._store / name).write_text(dump(schedule, "\n".join(lines)), encoding="utf-8")
        return {
            "seed": seed,
            "breaches": [breach._asdict() for breach in finding.breaches],
            "schedule": asdict(schedule),
            "file": str(self._store / name),
        }


def search_rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return a table of a search: each invariant with an upper bound of its failure probability.

    The bound is the rule of three: with 0 breaches in N flights, p < 3/N with 95 % confidence.
    """
    lines: list[tuple[str, ...]] = [("invariant", "broken in", "of N", "95 % bound")]
    for name, words in INVARIANTS.items():
        judged, broken = (document["invariants"][name][each] for each in ("judged", "broken"))
        bound = "not judged" if not judged else "-" if broken else f"p < {min(3 / judged, 1):.2g}"
        lines.append((words, str(broken) if judged else "-", str(judged), bound))
    return lines


def search_summary(document: dict[str, Any]) -> str:
    """Describe a search in one sentence: flights, failures, least distance to fence, top speed."""
    return (
        f"{document['count']} {document['kind']} schedules in {document['seconds']:.0f} s, seeds "
        f"{document['first']} to {document['next'] - 1}: {len(document['failures'])} broken, "
        f"{document['missions_done']} missions done, nearest to the fence "
        f"{document['smallest_margin_m']:.3f} m, fastest {document['largest_speed_mps']:.2f} m/s"
    )
