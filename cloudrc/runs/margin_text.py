"""Format the answers of a search for a stability margin for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cloudrc.runs.margin import ValueRange
from cloudrc.runs.trials import Trial, Trials


def as_text(
    document: Mapping[str, Any], found: Mapping[str, ValueRange | None], trials: Trials
) -> str:
    """Format the result `document` of `trials`, and the ranges found for each question."""
    lines = [_answer(name, each, trials) for name, each in found.items()]
    if "large_step" in document:
        lines.insert(1, _large(document["large_step"]))
    return "\n".join(lines)


def _answer(name: str, found: ValueRange | None, trials: Trials) -> str:
    """Return the answer to one question in one line."""
    if found is None:
        return f"{name}: not asked, because the step does not depend on this key"
    if found.first is None or found.last is None:
        first = trials.bottom
        failed = result(name, trials.trial(name, first))
        return f"no value {_verb(name)}; {trials.name(first)} fails: {failed}"
    start = f" from {trials.name(found.first)}" if found.below is not None else ""
    text = f"{name}{start} up to {trials.name(found.last)}"
    if found.above is None:
        text += f", {trials.top_why}"
    for number in (found.above, found.below):
        if number is not None:
            failed = result(name, trials.trial(name, number))
            text += f"; fails at {trials.name(number)}: {failed}"
    for first, last in found.elsewhere:
        reach = trials.name(first) + (f" to {trials.name(last)}" if last > first else "")
        text += f"; beyond values that fail, {reach} {_verb(name)}, too"
    return text


def _verb(name: str) -> str:
    return "is stable" if name == "stable" else "settles"


def result(question: str, trial: Trial) -> str:
    """Return "yes", or in one line why the answer to the question is no with one value."""
    if trial[question]:
        return "yes"
    where = f", seed {trial['seed']}" if "seed" in trial else ""
    return f"{trial['code']}{where}: {trial['text'].partition(';')[0]}"


def _large(large: Trial) -> str:
    """Say whether a step of 1 m dies out at the largest stable value, and whether it saturates."""
    dies = "dies out, too" if large["stable"] else f"does not die out ({large['text']})"
    text = f"with this value a step of {large['size_m']:g} m per axis {dies}; the guard's speed cap"
    cap, share = f"of {large['speed_max_mps']:.3g} m/s", large.get("speed_limited", 0.0)
    return f"{text} {cap} shortens " + (f"{share:.1%} of the commands" if share else "no command")
