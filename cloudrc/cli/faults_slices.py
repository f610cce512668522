"""Slices of a search for faults: what one has shown as plain values, and how they are added up."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from cloudrc import __version__
from cloudrc.cli.faults_page import INVARIANTS, PROMISES, command
from cloudrc.errors import BadInputError, in_one_line
from cloudrc.files import put

PACKAGE = Path(__file__).resolve().parents[1]
READ = (".py", ".xml", ".yaml")
"""Endings of what a flight may depend on."""
NOT_FLOWN = (
    *("_chart/", "cli/", "cluster/", "faults/cluster/", "faults/real/", "report/figures/"),
    *("drivers/probes", "drivers/sounder", "drivers/standing_"),
    *("link/netem", "link/relay", "link/trace_", "link/verify_"),
)
"""How the names of that begin which no flight in virtual time depends on."""
SUMS = ("count", "hours", "seconds", "holds", "missions_done", "fallen", "thrown", "landed_on")
ADDED = (*SUMS, "failures")
WORST = {"smallest_margin_m": min, "largest_speed_mps": max, "fallen_m": max, "thrown_m": max}
SAME = ("schemaVersion", "kind", "version", "sources")

Document = dict[str, Any]


def sources(package: Path = PACKAGE, apart: tuple[str, ...] = NOT_FLOWN) -> str:
    """Hash this package: SHA-256, in hexadecimal digits.

    Args:
        package: Its folder.
        apart: What is left out; unless told, all that no flight in virtual time depends on.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package).as_posix()
        if path.suffix in READ and not name.startswith(apart):
            data = path.read_bytes()
            digest.update(b"%s %d " % (name.encode(), len(data)) + data)
    return digest.hexdigest()


def document(findings: Sequence[Document], failures: Sequence[Document], **what: Any) -> Document:
    """Tell what some flights have shown.

    Args:
        findings: Of each flight, in brief.
        failures: What broke, shrunk.
        what: `kind`, `first`, `seconds` and `sources`.
    """
    return {
        "schemaVersion": 1,
        "kind": what["kind"],
        "first": what["first"],
        "count": len(findings),
        "version": __version__,
        "sources": what["sources"],
        "hours": sum(each["duration"] for each in findings) / 3600.0,
        "seconds": what["seconds"],
        "invariants": {
            kind: _judge(
                sum(kind in each["judged"] for each in findings),
                sum(kind in each["kinds"] for each in findings),
            )
            for kind in INVARIANTS
        },
        "smallest_margin_m": min((each["margin"] for each in findings), default=0.0),
        "largest_speed_mps": max((each["speed"] for each in findings), default=0.0),
        "holds": sum(each["holds"] for each in findings),
        "missions_done": sum(each["missions"] for each in findings),
        "fallen": sum(each["fallen"] > 0.0 for each in findings),
        "thrown": sum(each["thrown"] > 0.0 for each in findings),
        "landed_on": sum(each["landed_on"] for each in findings),
        "fallen_m": max((each["fallen"] for each in findings), default=0.0),
        "thrown_m": max((each["thrown"] for each in findings), default=0.0),
        "failures": list(failures),
    }


def keep(told: Document, path: Path) -> None:
    """Write a slice in one step: whoever is killed meanwhile leaves the one before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    put(path, f"{json.dumps(told, indent=2)}\n".encode())


def merged(paths: Sequence[Path]) -> tuple[Document, list[tuple[Path, Document]]]:
    """Add slices up.

    Args:
        paths: Of the slices, in any order.

    Returns:
        The whole, and the slices by their seeds.

    Raises:
        BadInputError: If one is no slice, is of another kind or of other sources than the rest, or
            if a seed is in two of them or in none.
    """
    parts = sorted(((path, _load(path)) for path in paths), key=lambda part: part[1]["first"])
    (first_path, whole), *_ = parts
    for path, part in parts[1:]:
        for name in SAME:
            if part[name] != whole[name]:
                raise BadInputError(
                    f"{path}: {name} {part[name]}, but {first_path} has {whole[name]}; "
                    "add up slices of one search, flown by the same sources"
                )
    for before, after in pairwise(parts):
        _refuse_unless_next(before, after)
    every = [part for _, part in parts]
    whole = dict(whole)
    for name in ADDED:
        whole[name] = sum((part[name] for part in every[1:]), start=whole[name])
    for name, worst in WORST.items():
        whole[name] = worst(part[name] for part in every)
    whole["invariants"] = {kind: _judge(*_counts(kind, every)) for kind in INVARIANTS}
    return whole, parts


def _load(path: Path) -> Document:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        text = getattr(error, "strerror", None) or in_one_line(str(error))
        raise BadInputError(f"{path}: cannot be read as a slice: {text}") from error
    if not (isinstance(told, dict) and _is_slice(told)):
        raise BadInputError(f"{path}: is no slice; write one by 'cloudrc faults fuzz --slice FILE'")
    if problem := _contradiction(told):
        raise BadInputError(f"{path}: {problem}; fly it anew: cloudrc faults fuzz --slice FILE")
    return told


def _contradiction(told: Document) -> str:
    """What cannot be of flights that were flown, in words; "" if all can."""
    if told["first"] < 0:
        return f"its first seed is {told['first']}, below 0"
    most = max(each["judged"] for each in told["invariants"].values())
    if most != told["count"]:  # some invariants are looked at in every flight
        return f"count {told['count']}, but its invariants were looked at in {most} flights"
    for kind, each in told["invariants"].items():
        if not 0 <= (each["broken"] or 0) <= each["judged"]:
            return f"{kind}: broken in {each['broken']} of {each['judged']} flights"
    return ""


def _is_slice(told: Document) -> bool:
    """Whether everything is there, and of its type, that is added up."""
    numbers = (*SUMS, *WORST, "first")
    judged = told.get("invariants")
    return (
        all(_is_number(told.get(name)) for name in numbers)
        and isinstance(told["count"], int)
        and isinstance(told["first"], int)
        and told["count"] > 0
        and isinstance(told.get("failures"), list)
        and all(name in told for name in SAME)
        and told["kind"] in tuple(PROMISES)
        and isinstance(told["version"], str)
        and isinstance(told["sources"], str)
        and isinstance(judged, dict)
        and judged.keys() == INVARIANTS.keys()
        and all(
            isinstance(each, dict) and _is_number(each.get("judged")) for each in judged.values()
        )
        and all(
            each.get("broken") is None or _is_number(each["broken"]) for each in judged.values()
        )
    )


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and value == value


def _refuse_unless_next(before: tuple[Path, Document], after: tuple[Path, Document]) -> None:
    """The second slice has to begin where the first one ends."""
    (path, part), (next_path, next_part) = before, after
    end, begin = part["first"] + part["count"], next_part["first"]
    if begin < end:
        last = min(end, begin + next_part["count"]) - 1
        raise BadInputError(
            f"{next_path}: seeds {begin} to {last} are in {path}, too; leave one of the two out"
        )
    if begin > end:
        missing = part | {"first": end, "count": begin - end}
        raise BadInputError(
            f"seeds {end} to {begin - 1} are missing between {path} and {next_path}; "
            f"fly them: {command(missing)} --slice FILE"
        )


def _counts(kind: str, parts: Sequence[Document]) -> tuple[int, int]:
    """In how many flights an invariant was looked at, and in how many it broke."""
    told = [part["invariants"][kind] for part in parts]
    return sum(each["judged"] for each in told), sum(each["broken"] or 0 for each in told)


def _judge(looked_at: int, broken: int) -> Document:
    """One invariant: in how many flights it was looked at, and in how many it broke."""
    # Rule of three: 0 events in N runs mean p < 3/N with 95 % confidence.
    # Source: J. A. Hanley, A. Lippman-Hand, JAMA 249(13), 1983.
    bound = min(3.0 / looked_at, 1.0) if looked_at and not broken else None
    return {"judged": looked_at, "broken": broken if looked_at else None, "bound": bound}
