# SPDX-License-Identifier: Apache-2.0

"""Judge the rows of an evaluation: what survives, what differs, and what only looks better.

All rows have equal seeds. Those without a network come first, the others by rising round trip.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, pairwise, zip_longest
from statistics import fmean, median
from typing import Any

from cloudrc.base.statistics import LEVEL, by_chance, exact_interval, median_interval, tail
from cloudrc.flight.trials.rows import Row
from cloudrc.flight.trials.summary import Pair, adjust, compare_number, compare_success
from cloudrc.studies.eval.setup import BASELINE

Groups = Mapping[str, Mapping[float | None, Sequence[Row]]]
"""Executor -> round trip [ms] -> the rows of this condition."""
WEIGHTS = {
    "stale_share": "steps",
    "observation_age": "observation_age_of",
    "action_age": "action_age_of",
    "late_share": "action_age_of",
    **dict.fromkeys(("loop_age", "observation_age_p99", "action_age_p99", "seam_jump")),
    **dict.fromkeys(("observation_age_peak", "action_age_peak")),
    **dict.fromkeys(("delay_asked_uplink", "delay_asked_downlink")),
    **dict.fromkeys(("delay_measured_uplink", "delay_measured_downlink")),
    **dict.fromkeys(("loss_uplink", "loss_downlink", "frames_shown", "observation_bytes")),
}
"""Number of an episode whose mean a summary has -> steps that it is of; None: episodes count."""
LARGEST = (
    ("misses_in_10", "", 1),
    ("observation_age_max", "_ms", 1e3),
    ("action_age_max", "_ms", 1e3),
)
"""Numbers of an episode whose largest a summary has: name, suffix and factor of its unit."""
SEEDS_CHANGED = (
    "The number of seeds has changed in this folder: {}. If a result was seen in between, a claim "
    "is wrong more often than 5 %; decide the number, and play it in a new folder"
)
NOTHING = (
    "survival is unknown: no episode without a network is known to succeed; --success-at says "
    "what a success is"
)


def group(rows: Sequence[Row]) -> Groups:
    """Group rows by their condition, in the order in which the conditions first occur."""
    found = dict[str, dict[float | None, list[Row]]]()
    for row in rows:
        at = found.setdefault(row["point"]["executor"], {})
        at.setdefault(row["point"]["rtt_ms"], []).append(row)
    return found


def summarize(rtt_ms: float | None, executor: str, rows: Sequence[Row]) -> dict[str, Any]:
    """Summarise a condition, of the mean round trip `rtt_ms` [ms], in plain values.

    Medians and rates have their 95 % interval: `_low` and `_high`. Means of steps are pooled, and
    `_of` is the number of steps. Of the missed steps the worst window counts, of ages also the
    largest. Ages and delays are
    in ms, `age_counts` has steps. `unanswered` are the episodes that ended before a second answer
    could act. What is not known is left out.
    """
    numbers: list[Mapping[str, float]] = [row["numbers"] for row in rows]
    ends, count = [row["ended"] for row in rows], len(rows)
    found: dict[str, Any] = {"rtt_ms": rtt_ms, "executor": executor, "episodes": count}
    for name in ("return", "steps"):
        values = [each[name] for each in numbers]
        found |= _estimate(name, median(values), median_interval(values))
    if all("success" in each for each in numbers):
        found["successes"] = done = int(sum(each["success"] for each in numbers))
        found |= _estimate("success", done / count, exact_interval(done, count))
    for name, unit, factor in LARGEST:
        if known := [each[name] for each in numbers if name in each]:
            found[f"{name}{unit}"] = max(known) * factor
    counts = (row.get("age_counts", ()) for row in rows)
    found["age_counts"] = list(map(sum, zip_longest(*counts, fillvalue=0)))
    found["unanswered"] = sum("loop_age" not in each for each in numbers)
    found |= {end: ends.count(end) for end in ("terminated", "truncated", "limit")}
    return {**found, "terminated_share": found["terminated"] / count, **dict(_means(numbers))}


def _estimate(name: str, value: float, interval: tuple[float, float] | None) -> dict[str, float]:
    return {name: value, **dict(zip((f"{name}_low", f"{name}_high"), interval or (), strict=False))}


def _means(numbers: Sequence[Mapping[str, float]]) -> Iterator[tuple[str, float]]:
    for name, weight in WEIGHTS.items():
        known = [each for each in numbers if name in each]
        weights = [each[weight] if weight else 1.0 for each in known]
        if sum(weights):
            mean = fmean([each[name] for each in known], weights)
            yield (f"{name}_ms", 1e3 * mean) if "age" in name or "delay" in name else (name, mean)
            if weight:
                yield f"{name}_of", sum(weights)


def survivals(groups: Groups, share: float = 0.5) -> list[dict[str, Any]]:
    """Find for each executor up to which round trip the policy survives, also in words.

    From the smallest round trip on, an exact test asks of the seeds with a success without a
    network whether more than this `share` [1] has a success over the network. The first round trip
    at which this is not shown ends the sequence, so that its round trips need no adjustment. Each
    of k executors has the level .05 / k (Bonferroni): the probability that any claim is wrong is at
    most 5 %.

    Source: A. C. Tamhane, C. W. Dunnett, J. W. Green, J. D. Wetherington, "Multiple test procedures
    for identifying the maximum safe dose", 2001.
    """
    base, found = _seeds(groups[BASELINE][None]), list[dict[str, Any]]()
    least = least_kept(len(base), len(groups) - 1, share)
    for executor, conditions in groups.items():
        each: dict[str, Any] = {"executor": executor, "of": len(base)}
        text = f"{executor} is not shown to survive a round trip that was asked"
        if least is None:
            text += f": {len(base)} successes without a network are too few to show it"
        for rtt, rows in conditions.items():
            kept = len(base & _seeds(rows))
            p = tail(len(base) - kept, len(base), 1.0 - share)
            each |= {"tried_ms": rtt, "kept": kept, "p": p}
            if least is None or kept < least:
                text += f"; at {place(rtt)} it keeps {kept} of {len(base)} successes"
                break
            each["up_to_ms"] = rtt
            text = f"{executor} survives up to {place(rtt)}"
        found.append({**each, "text": text})
    return found[1:]


def least_kept(count: int, executors: int, share: float = 0.5) -> int | None:
    """Return how many of `count` successes show that more than `share` [1] is kept; None: too few.

    Each of the `executors` has an equal part of the 5 % at which a claim may be wrong.
    """
    level = LEVEL / max(1, executors)
    numbers = range(count + 1)
    return next((n for n in numbers if tail(count - n, count, 1.0 - share) < level), None)


def explain_survival(count: int, executors: int) -> str:
    """Say what "survives" means with so many successes without a network, and executors."""
    least = least_kept(count, executors)
    told = f"{least} of these {count}" if least else f"more than these {count}"
    together = f" for the {executors} executors together" if executors > 1 else ""
    return (
        f"Survives up to N ms: with 95 % confidence{together}, at each asked round trip up to N ms "
        "the policy succeeds in more than half of the episodes in which it succeeds without a "
        f"network. It takes {told}: each executor is tested at the level "
        f"{LEVEL / max(1, executors):.2g}. What is not shown may still hold. This is true if the "
        "number of seeds was decided before the first result was seen."
    )


def _seeds(rows: Sequence[Row]) -> set[int]:
    return {row["seed"] for row in rows if row["verdict"] == "success"}


def place(rtt_ms: float | None) -> str:
    """Name the round trip `rtt_ms` [ms] in words; None is that of the profile."""
    return "the profile's round trip" if rtt_ms is None else f"{rtt_ms:g} ms"


def compare_conditions(groups: Groups, before: Groups, name: str) -> list[dict[str, Any]]:
    """Test whether success and return differ between A and B, in pairs of equal seeds.

    A and B are every two executors at the same round trip; and, for each condition, the rows
    `before`, of an evaluation of this `name`, and those of `groups`. All tests are one family for
    Holm's p.
    """
    sides = [
        (f"{executor} of {name}", before.get(executor, {}), executor, groups[executor])
        for executor in groups
    ]
    others = list(groups.items())[1:]
    sides += [(*first, *second) for first, second in combinations(others, 2)]
    found = [
        {"rtt_ms": rtt, "a": a, "b": b, **_compare(first[rtt], second[rtt])}
        for a, first, b, second in sides
        for rtt in first
        if rtt in second
    ]
    adjust([each[name] for each in found for name in ("success", "return") if name in each])
    return found


def _compare(first: Sequence[Row], second: Sequence[Row]) -> dict[str, Any]:
    of_seed = {row["seed"]: row for row in first}
    pairs = [Pair({}, of_seed[row["seed"]], row) for row in second if row["seed"] in of_seed]
    found = {"return": compare_number(pairs, "return", "")}
    if all("success" in row["numbers"] for row in (*first, *second)):
        found["success"] = compare_success(pairs)
    return found


def judge(
    rows: Sequence[Row], before: Sequence[Row] = (), name: str = "", seeds: Sequence[int] = ()
) -> dict[str, Any]:
    """Return summaries, survival and tests of rows, and notes on them.

    The rows `before` are those of another policy, in the folder `name`; `seeds` are the different
    numbers of seeds that the calls asked for.
    """
    groups = group(rows)
    outcomes = [
        summarize(rtt, executor, some)
        for executor, at in groups.items()
        for rtt, some in at.items()
    ]
    tests, survival = compare_conditions(groups, group(before), name), []
    notes = [NOTHING]
    if outcomes[0].get("successes"):
        survival = survivals(groups)
        words = explain_survival(survival[0]["of"], len(survival))
        notes = [words, *(each["text"] for each in survival)]
    if len(seeds) > 1:
        notes.append(SEEDS_CHANGED.format(", then ".join(map(str, seeds))))
    intervals = [key for each in outcomes for key in each if key.endswith("_low")]
    count = len(intervals) + sum(len(each.keys() & {"success", "return"}) for each in tests)
    notes += [*beginnings(outcomes), *doubts(outcomes), *told(groups)]
    if count > 1:
        notes.append(by_chance(count))
    return {
        "versus": name,
        "outcomes": outcomes,
        "survival": survival,
        "tests": tests,
        "notes": notes,
    }


def beginnings(outcomes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Count the episodes over a network that ended before a second answer could act."""
    found = [
        f"{each['executor']} at {place(each['rtt_ms'])} {each['unanswered']} of {each['episodes']}"
        for each in outcomes[1:]
        if each["unanswered"]
    ]
    if found:
        yield (
            "episodes that ended before a second answer could act tell of their beginning "
            f"(--start), not of the policy: {', '.join(found)}"
        )


def told(groups: Groups) -> Iterator[str]:
    """Repeat what `Networked` warned of, with the conditions."""
    found = dict[str, dict[str, None]]()
    for executor, at in groups.items():
        for rtt, rows in at.items():
            for text in (text for row in rows for text in row.get("doubts", ())):
                found.setdefault(text, {})[f"{executor} at {place(rtt)}"] = None
    for text, where in found.items():
        yield f"{', '.join(where)}: {text}"


def doubts(outcomes: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Say for which conditions the return is better in shorter episodes, without more successes.

    A condition is compared with the next smaller round trip and with that without a network.
    """
    found = list[str]()
    for before, each in pairwise(outcomes):
        others = (outcomes[0], before if before["executor"] == each["executor"] else outcomes[0])
        if any(_flatters(each, other) for other in others):
            found.append(f"{each['executor']} at {place(each['rtt_ms'])}")
    if found:
        yield (
            "the return improves while the episodes get shorter, as if a crash ended the costs: "
            f"{', '.join(found)}"
        )


def _flatters(each: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether a condition only looks better than another one."""
    succeeds = each.get("successes") and each["successes"] >= other.get("successes", 0)
    is_shorter = each.get("steps_high", each["steps"]) < other["steps"]
    return each["return"] > other["return"] and is_shorter and not succeeds
