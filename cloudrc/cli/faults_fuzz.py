"""`cloudrc faults fuzz` and `replay`: random schedules of faults, and stored ones."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import paint, table, written
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.faults.fuzz import Finding
    from cloudrc.faults.schedule import Schedule

FAILED = 1
CHUNK = 4
"""Schedules given to a process at a time."""
INVARIANTS = {
    "collision": "collisions",
    "fence": "fence breaches",
    "cap": "cap breaches",
    "stop": "too fast towards the fence",
    "stale": "motion on stale commands",
    "stuck": "stuck states",
    "alarm": "false alarms",
    "recording": "recordings that do not hold what happened",
    "error": "errors in an end",
}
PROMISES = {"random": "P-FAULT-2", "adversarial": "P-FAULT-3", "clean": "P-FAULT-4"}
"""Ids in `docs/safety/promises.md`."""
NOTES = {
    "adversarial": (
        "",
        "The cloud holds valid keys. Every second one flies amid faults of all kinds, every tenth",
        "speaks in its operator's place. A robot that this has stopped may come to lie outside the",
        "fence, a [known limit](guard.md): it is told below the table, and a breach beyond 1.5 m.",
    )
}
"""What else is to be said, by kind."""
PROGRESS_PERIOD = 10.0
"""Between two lines of progress [s]."""


def fuzz(options: argparse.Namespace) -> int:
    """Fly many random schedules; 1 if an invariant broke."""
    began, findings = time.monotonic(), list[Any]()
    seeds = range(options.first, options.first + options.seeds)
    say = options.output == "table"
    told, failures = began, list[Any]()
    for finding in _findings(seeds, options):
        findings.append(_brief(finding))
        if finding.breaches:
            failures.append(_report(finding, options.store, say))
        if say and time.monotonic() - told > PROGRESS_PERIOD:
            told = time.monotonic()
            print(f"{len(findings)} of {options.seeds} flown, {len(failures)} failed", flush=True)
    seconds = time.monotonic() - began
    document = _document(findings, failures, options, seconds)
    if options.document is not None:
        options.document.write_text(_markdown(document, _command(options)), encoding="utf-8")
    if say:
        print("\n" + table(_rows(document), right=(1, 2)))
        print(f"\n{_summary(document)}")
    else:
        print(written(document, options.output))
    return FAILED if failures else 0


def replay(options: argparse.Namespace) -> int:
    """Fly a stored schedule; 1 if an invariant breaks."""
    from cloudrc.faults.fuzz import fly
    from cloudrc.faults.schedule import load

    try:
        finding = fly(load(options.file), keep=True)
    except BadInputError as error:  # a profile or a policy that there is not
        where = "" if str(options.file) in str(error) else f"{options.file}: "
        raise BadInputError(f"{where}{error}") from error
    breaches = [breach._asdict() for breach in finding.breaches]
    if options.output != "table":
        document = {"schemaVersion": 1, "records_sha256": finding.sha256, "breaches": breaches}
        print(written(document, options.output))
    else:
        for breach in finding.breaches:
            print(f"{breach.time:8.3f} s  {breach.kind}: {breach.text}")
        print(f"{'FAILED' if breaches else 'passed'}  records {finding.sha256[:16]}")
    return FAILED if breaches else 0


def _findings(seeds: Iterable[int], options: argparse.Namespace) -> Iterator[Finding]:
    work = [(seed, _kind(options)) for seed in seeds]
    if options.jobs == 1:
        yield from map(_fly, work)
        return
    with ProcessPoolExecutor(options.jobs) as pool:
        yield from pool.map(_fly, work, chunksize=CHUNK)


def _kind(options: argparse.Namespace) -> str:
    return "adversarial" if options.adversarial else "clean" if options.clean else "random"


def _fly(which: tuple[int, str]) -> Finding:
    from cloudrc.faults.adversary import choose
    from cloudrc.faults.compose import calm, compose
    from cloudrc.faults.fuzz import fly

    seed, kind = which
    return fly({"adversarial": choose, "clean": calm, "random": compose}[kind](seed))


def _brief(finding: Finding) -> dict[str, Any]:
    from cloudrc.faults.fuzz import judged

    return {
        "judged": judged(finding.schedule),
        "kinds": finding.kinds,
        "margin": finding.margin,
        "speed": finding.speed,
        "holds": finding.holds,
        "missions": finding.missions,
        "fallen": finding.fallen,
        "duration": finding.schedule.duration,
    }


def _report(finding: Finding, store: Path, say: bool) -> dict[str, Any]:
    """Shrink a failing schedule, print it, and keep it."""
    from cloudrc.faults.fuzz import fly
    from cloudrc.faults.schedule import dump
    from cloudrc.faults.shrink import shrink

    kinds = finding.kinds

    def fails(schedule: Schedule) -> bool:
        return bool(fly(schedule).kinds & kinds)

    smallest = shrink(finding.schedule, fails)
    breaches = fly(smallest).breaches
    note = "\n".join(f"{b.time:.3f} s: {b.kind}: {b.text}" for b in breaches[:3])
    text = dump(smallest, f"Found by seed {finding.schedule.seed}.\n{note}")
    if say:
        print(f"\n{paint('FAILED', 'red')} seed {finding.schedule.seed}\n{text}", flush=True)
    store.mkdir(parents=True, exist_ok=True)
    path = store / f"{'-'.join(sorted(kinds))}-{smallest.policy or 'seed'}-{smallest.seed}.yaml"
    path.write_text(text, encoding="utf-8")
    return {
        "seed": finding.schedule.seed,
        "breaches": [breach._asdict() for breach in finding.breaches],
        "schedule": asdict(smallest),
        "file": str(path),
    }


def _document(
    findings: list[dict[str, Any]],
    failures: list[dict[str, Any]],
    options: argparse.Namespace,
    seconds: float,
) -> dict[str, Any]:
    count = len(findings)
    return {
        "schemaVersion": 1,
        "kind": _kind(options),
        "first": options.first,
        "count": count,
        "hours": sum(each["duration"] for each in findings) / 3600.0,
        "seconds": seconds,
        "invariants": {kind: _judge(kind, findings) for kind in INVARIANTS},
        "smallest_margin_m": min(each["margin"] for each in findings),
        "largest_speed_mps": max(each["speed"] for each in findings),
        "holds": sum(each["holds"] for each in findings),
        "missions_done": sum(each["missions"] for each in findings),
        "fallen": sum(each["fallen"] > 0.0 for each in findings),
        "fallen_m": max(each["fallen"] for each in findings),
        "failures": failures,
    }


def _judge(kind: str, findings: list[dict[str, Any]]) -> dict[str, Any]:
    """One invariant: in how many flights it was looked at, and in how many it broke."""
    looked_at = sum(kind in each["judged"] for each in findings)
    broken = sum(kind in each["kinds"] for each in findings)
    # Source: the rule of three: 0 events in N runs, p < 3/N with 95 % confidence.
    bound = min(3.0 / looked_at, 1.0) if looked_at and not broken else None
    return {"judged": looked_at, "broken": broken if looked_at else None, "bound": bound}


def _rows(document: dict[str, Any]) -> list[tuple[str, ...]]:
    """Each invariant with its bound."""
    rows: list[tuple[str, ...]]
    rows = [("invariant", "broken in", "of N", "95 % bound")]
    for kind, words in INVARIANTS.items():
        broken, judged, bound = (
            document["invariants"][kind][name] for name in ("broken", "judged", "bound")
        )
        if not judged:
            rows.append((words, "-", "0", "not judged"))
            continue
        rows.append((words, str(broken), str(judged), "-" if broken else f"p < {bound:.2g}"))
    return rows


def _summary(document: dict[str, Any]) -> str:
    fallen = (
        f"; {document['fallen']} stopped by the operator's word came to lie outside of it, at most "
        f"by {document['fallen_m']:.2f} m"
    )
    return (
        f"{document['hours']:.2f} virtual hours of {document['kind']} schedules from seed "
        f"{document['first']} on in {document['seconds']:.0f} s: "
        f"{document['missions_done']} missions done, {document['holds']} HOLDs, "
        f"nearest to the fence {document['smallest_margin_m']:.3f} m, "
        f"fastest {document['largest_speed_mps']:.2f} m/s" + (fallen if document["fallen"] else "")
    )


def _command(options: argparse.Namespace) -> str:
    """The command that flies the same once more; where it keeps what it finds changes nothing."""
    kind = _kind(options)
    words = ["cloudrc faults fuzz", *([f"--{kind}"] if kind != "random" else [])]
    words += [f"--first {options.first}"] if options.first != 1 else []
    return " ".join([*words, f"--seeds {options.seeds}", f"--document {options.document}"])


def _markdown(document: dict[str, Any], command: str) -> str:
    """For the documentation."""
    head, *rows = _rows(document)
    lines = [
        f"# The search for faults: {document['kind']} schedules",
        "",
        f"Written by `{command}`;",
        "do not edit. Each schedule is one minute of flight; the",
        "invariants are looked at in every step of 2 ms. The bound is by the rule of three:",
        "0 events in N runs, p < 3/N with 95 % confidence. N counts the schedules in which an",
        "invariant is looked at: under a cloud that means no good a contact is no breach, and",
        "only where nothing goes wrong a HOLD is a false alarm. The promise is "
        f"[{PROMISES[document['kind']]}].",
        *NOTES.get(document["kind"], ()),
        "",
        f"| {' | '.join(head)} |",
        "|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        _summary(document) + ".",
        "",
    ]
    return "\n".join(lines)
