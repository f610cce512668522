"""Fly random schedules for some minutes to find breaches of invariants, and store them.

Seeds are consecutive numbers. To continue a search that ended before seed N, use `--first N`.
"""

from __future__ import annotations

import time
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
    """A search for faults that break an invariant; `document` is the result so far, for JSON."""

    def __init__(self, kind: str, first: int, store: Path) -> None:
        """Prepare a search from the seed `first` on; `kind` is a key of `KINDS`.

        The search writes schedules that break an invariant to the folder `store`.
        """
        self._store = store
        self.document: dict[str, Any] = {
            "schemaVersion": 1,
            "kind": kind,
            "first": first,
            "next": first,
            "count": 0,
            "seconds": 0.0,
            "invariants": {name: {"judged": 0, "broken": 0} for name in INVARIANTS},
            "smallest_margin_m": 9.0,
            "largest_speed_mps": 0.0,
            "missions_done": 0,
            "failures": [],
        }

    def run(
        self, minutes: float, call: Map, jobs: int = 1
    ) -> Generator[dict[str, Any] | None, None, None]:
        """Fly one flight per seed for `minutes` [min]; `call` runs them in `jobs` processes.

        Yields:
            After each flight: the stored failure, or None if no invariant was broken.
        """
        began, found = time.monotonic(), self.document
        while True:
            chunk = [(found["kind"], found["next"] + n) for n in range(CHUNK)]
            for finding in call(fly_seed, chunk, jobs):
                failure = self._take(finding)
                found["seconds"] = time.monotonic() - began
                yield failure
                if found["seconds"] >= 60.0 * minutes:
                    return

    def _take(self, finding: Finding) -> dict[str, Any] | None:
        found, judged = self.document, checked_in(finding.schedule)
        found["next"] += 1
        found["count"] += 1
        for name, counts in found["invariants"].items():
            counts["judged"] += name in judged
            counts["broken"] += name in finding.kinds
        found["smallest_margin_m"] = min(found["smallest_margin_m"], finding.margin)
        found["largest_speed_mps"] = max(found["largest_speed_mps"], finding.speed)
        found["missions_done"] += finding.missions
        if not finding.breaches:
            return None
        failure = self._keep(finding)
        found["failures"].append(failure)
        return failure

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
