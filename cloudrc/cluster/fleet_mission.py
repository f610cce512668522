# SPDX-License-Identifier: Apache-2.0

"""Follow the Job of a fleet: a pod per robot, whose completion index is the robot's number.

A watch tells which pods have ended: two requests a second for any number of robots. The metrics of
each robot are read once before and once after its mission, five robots a second.
"""

from __future__ import annotations

import csv
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.prometheus import Metrics, read_metrics, total
from cloudrc.cluster.client import ClusterError, Release, run
from cloudrc.cluster.jobs import AT, KILLED_WATCHER, Ended, JobReader, read_end
from cloudrc.cluster.pods import (
    CELL,
    DATA,
    INDEX,
    METRICS,
    find_pod,
    list_pods,
    read_page,
)

if TYPE_CHECKING:
    from cloudrc.link.cell import Usage

ROBOT = "batch.kubernetes.io/job-completion-index"
"""Annotation of a Job's pod: the robot that it flies."""
PAUSE = 0.2
"""Time between the requests for the metrics of two robots [s]: 5 requests a second."""
COUNTERS = (
    "cloudrc_command_age_seconds_sum",
    "cloudrc_command_age_seconds_count",
    "cloudrc_guard_held_seconds_total",
)
"""Counters of world: ages of all commands [s], number of commands, time in HOLD [s]."""


def follow_fleet(release: Release, name: str, tell: Callable[[str], None]) -> Ended:
    """Follow the Job of a fleet until all robots have ended; `tell` receives each verdict.

    At the end, `tell` receives the summary that `cloudrc run` prints of a fleet. The exit code is
    the largest of all robots.
    """
    from cloudrc.results.report.fleet import summarize_fleet

    before = _read_robots(release)
    job = release.request("get", "jobs", name=name)
    words = job.spec.template.spec.containers[0].args
    left = max(float(word.removeprefix(AT)) for word in words if AT in word) - time.time()
    if left > 0:
        tell(f"{job.spec.completions} robots begin together in {left:.0f} s")
        time.sleep(left)
    else:
        tell("the robots fly already: ages and HOLD count from now on")
    start = max((each.time_s for each in _read_cell(release)), default=0.0)
    ended = {
        robot: Ended(ClusterError.exit_code, "", ("no_verdict",))
        for robot in range(job.spec.completions)
    }

    def see_end(pod: Any, state: Any) -> str:
        if state.exit_code in KILLED_WATCHER:  # a new pod follows the mission
            return ""
        robot = int(pod.metadata.annotations[ROBOT])
        ended[robot] = read_end(state)
        return f"robot {robot}: {ended[robot].message or state.reason}"

    for _ in JobReader(release, name, tell, see_end, logs=False).read():
        pass
    record, after = _read_cell(release), _read_robots(release)
    rows = [
        {"robot": robot, **_verdict(end), **_flown(before[robot], after[robot])}
        for robot, end in ended.items()
    ]
    for line in ["", *summarize_fleet(_document(rows, record, start)).splitlines()]:
        tell(line)
    return Ended(max(end.exit_code for end in ended.values()), "")


def _verdict(end: Ended) -> dict[str, str]:
    """Return the verdict of a robot and the codes of its failures."""
    from cloudrc.results.metrics.verdict import EXIT_CODES

    named = {code: verdict for verdict, code in EXIT_CODES.items()}
    why = {"why": ", ".join(end.codes)} if end.codes else {}
    return {"verdict": named.get(end.exit_code, "interrupted"), **why}


def _flown(before: Metrics, after: Metrics) -> dict[str, float]:
    """Return the numbers of a robot's mission from its counters before and after it."""
    if not (before and after):
        return {}
    ages, count, held = (total(after, name) - total(before, name) for name in COUNTERS)
    return {"hold_s": held, **({"age_ms": ages / count * 1e3} if count > 0 else {})}


def _document(rows: list[dict[str, Any]], record: list[Usage], start: float) -> Any:
    """Return what the summary of a fleet needs.

    What the cell did after `start` [s] is its flight: all of it, if the cell has a new pod.
    """
    from cloudrc.results.report.fleet import cell_rows, judge_robots

    if record and record[-1].time_s < start:
        start = 0.0
    log = [replace(each, time_s=each.time_s - start) for each in record if each.time_s > start]
    for row in rows if log else ():
        row["dropped"] = sum(each.dropped.get(row["robot"], 0) for each in log)
    cell = cell_rows(log, len(rows), alone=False)  # others may send, too
    return {**judge_robots(rows), "cell": cell, "cloud": None, "separation_min_m": None}


def _read_cell(release: Release) -> list[Usage]:
    """Read what the cell has recorded so far; [] without a cell, or if it does not answer."""
    from cloudrc.link.cell import Usage

    if not release.find("statefulsets", CELL):
        return []
    try:
        pod = find_pod(release, CELL).metadata.name
        words = ["exec", pod, f"--container={CELL}", "--", "cat", f"{DATA}/cell.csv"]
        text = run("kubectl", [*release.flags, *words])
    except CloudrcError:  # the verdicts count
        return []
    lines = text.splitlines()[: text.count("\n")]  # the last line may be cut
    return [*map(Usage.read, csv.DictReader(lines))]


def _read_robots(release: Release) -> dict[int, Metrics]:
    """Read the metrics of each robot's world; those of a robot that does not answer are {}."""
    found = defaultdict[int, Metrics](dict)
    for pod in list_pods(release, "world"):
        time.sleep(PAUSE)
        try:
            text = read_page(release, pod.metadata.name, METRICS["world"]["world"])
        except ClusterError:
            continue
        found[int(pod.metadata.labels[INDEX])] = read_metrics(text)
    return found
