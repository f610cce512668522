# SPDX-License-Identifier: Apache-2.0

"""Score what an entry has done, and put entries in order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from cloudrc.studies.eval.evidence import least_kept, survivals
from cloudrc.studies.eval.setup import BASELINE
from cloudrc.studies.rank.tasks import CONSTANT

SHARE = 0.9
"""Share of its own successes that a policy has to keep."""
Results = Sequence[Mapping[str, Any]]
"""The conditions of an entry: `link`, `rtt_ms`, and `success`, a digit per seed."""


def score(results: Results) -> dict[str, Any]:
    """Return the score [ms] of an entry, also in words, and what it stands on.

    The score is the largest round trip up to which the policy is shown to keep more than
    `SHARE` of its own successes; None if nothing is shown. `area` is the area under the success
    over the round trip, relative to success everywhere; `of` is the number of successes without
    a network.
    """
    grid = {each["rtt_ms"]: each["success"] for each in results if each["link"] == CONSTANT}
    conditions = {rtt: _rows(digits) for rtt, digits in grid.items()}
    (found,) = survivals(
        {BASELINE: {None: _rows(results[0]["success"])}, "policy": conditions}, SHARE
    )
    count, seeds = found["of"], len(results[0]["success"])
    up_to = found.get("up_to_ms")
    if least_kept(count, 1, SHARE) is None:
        words = f"-, {count} of {seeds} without a network"
    else:
        words = "none" if up_to is None else f"{up_to:g} ms"
    return {"score_ms": up_to, "score": words, "area": round(_area(grid), 6), "of": count}


def _rows(digits: str) -> list[dict[str, Any]]:
    verdicts = {"0": "failure", "1": "success"}
    return [{"seed": n, "verdict": verdicts[each]} for n, each in enumerate(digits, start=1)]


def _area(grid: Mapping[float, str]) -> float:
    """Return the area by trapezoids, divided by the largest round trip [1]."""
    rates = [(rtt, digits.count("1") / len(digits)) for rtt, digits in grid.items()]
    parts = [(b - a) * (low + high) / 2 for (a, low), (b, high) in pairwise(rates)]
    return sum(parts) / rates[-1][0]


def in_order(entries: Iterable[Mapping[str, Any]]) -> list[tuple[int | None, Mapping[str, Any]]]:
    """Return the entries of a task with their places, the best first; equal scores share a place.

    Below those with a score are those that fail with an answer in its step, then those with too
    few successes without a network, then those that failed. These have no place.
    """
    found = list[tuple[int | None, Mapping[str, Any]]]()
    for n, entry in enumerate(sorted(entries, key=_key), start=1):
        place = None if entry["score_ms"] is None else n
        if place and found and found[-1][1]["score_ms"] == entry["score_ms"]:
            place = found[-1][0]
        found.append((place, entry))
    return found


def _key(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    up_to = entry["score_ms"]
    kinds = (up_to is not None, entry["score"] == "none", entry["score"].startswith("-"), True)
    best = kinds.index(True)
    return best, -(up_to or 0.0), -entry["area"], entry["policy"], entry["executor"]
