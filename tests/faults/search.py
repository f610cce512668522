# SPDX-License-Identifier: Apache-2.0

"""Fly random or hostile schedules of faults for a time, and count which invariants they break."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from typing import Any

from cloudrc.base.errors import CloudrcError
from cloudrc.flight.trials.workers import map_in_order, take_each
from tests.faults import trial
from tests.faults.adversary import choose
from tests.faults.schedule import compose, dump
from tests.faults.trial import INVARIANTS, TrialResult, checked_in


def search(
    fly: Callable[[int], TrialResult],
    first: int,
    minutes: float,
    jobs: int,
    see: Callable[[TrialResult], dict[str, Any]],
) -> tuple[dict[str, Any], CloudrcError | None]:
    """Fly the schedules of seeds from `first` on, for `minutes` [min], in `jobs` processes.

    Call `see` with each finding that has breaches; it returns the failure as values for JSON.
    Return the result of the search as values for JSON; and why it ended early, or None.
    """
    found: dict[str, Any] = {
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
    began = time.monotonic()

    def flown() -> Generator[TrialResult]:
        for finding in map_in_order(fly, count(first), jobs):
            yield finding
            if time.monotonic() - began >= 60.0 * minutes:
                return

    def take(finding: TrialResult) -> None:
        found["seconds"] = time.monotonic() - began
        _count(found, finding)
        if finding.breaches:
            found["failures"].append(see(finding))

    stopped = take_each(flown(), take)
    return found, stopped


def fly_seed(seed: int, hostile: bool, robot: str) -> TrialResult:
    """Fly the schedule for a seed: random faults, or a dishonest cloud with or without faults."""
    return trial.fly(replace((choose if hostile else compose)(seed), robot=robot))


def _count(found: dict[str, Any], finding: TrialResult) -> None:
    """Add the finding of the next seed to `found`, the document of a search."""
    for name in ("next", "count"):
        found[name] += 1
    for name in checked_in(finding.schedule):
        found["invariants"][name]["judged"] += 1
    for name in finding.kinds:
        found["invariants"][name]["broken"] += 1
    found["smallest_margin_m"] = min(found["smallest_margin_m"], finding.margin)
    found["largest_speed_mps"] = max(found["largest_speed_mps"], finding.speed)
    found["missions_done"] += finding.missions


def store(finding: TrialResult, folder: Path) -> dict[str, Any]:
    """Write a schedule that broke an invariant into `folder`; return the failure for JSON."""
    schedule, seed = finding.schedule, finding.schedule.seed
    name = f"{'-'.join(sorted(finding.kinds))}-{schedule.policy or 'seed'}-{seed}.yaml"
    lines = [f"{each.time:.3f} s: {each.kind}: {each.text}" for each in finding.breaches[:3]]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(dump(schedule, "\n".join(lines)), encoding="utf-8")
    return {
        "seed": seed,
        "breaches": [breach._asdict() for breach in finding.breaches],
        "schedule": asdict(schedule),
        "file": str(folder / name),
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
