# SPDX-License-Identifier: Apache-2.0

"""Format the result of a comparison of A and B for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cloudrc.base.statistics import LEVEL, by_chance
from cloudrc.base.text import FAILED_MARK, FAILED_NOTE, format_number, table
from cloudrc.flight.trials.summary import NO_RATIO, OFF_PATH
from cloudrc.results.metrics.measure import scale
from cloudrc.studies.compare import LEFT_OUT

TITLES = (
    "number",
    "A median",
    "B median",
    "B - A",
    "95 % interval",
    "B lower in",
    "p",
    "p Holm",
    "p sign",
    "decided",
    "unit",
)


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result of a comparison: a table and, in the last lines, the conclusion."""
    success, left_out = document["success"], document["left_out"]
    rates = [
        "{} {} of {} ({:.0%} .. {:.0%})".format(
            side.upper(), success[side], success["count"], *success[f"{side}_interval"]
        )
        for side in "ab"
    ]
    failed = (each["a_failed"] or each["b_failed"] for each in document["numbers"].values())
    lines = [
        *(f"{side.upper()}: {document[side]}" for side in "ab"),
        f"of {document['of']}; pairs: {document['pairs']}"
        + (f"; {left_out} left out with {LEFT_OUT}" if left_out else ""),
        "",
        table(cells(document), right=(1, 2, 3)),
        "",
        *map(lacking_text, document["lacking"].items()),
        f"success: {', '.join(rates)}, p = {success['p_mcnemar']:.2g}, "
        f"p Holm = {success['p_holm']:.2g}",
        document["method"],
        by_chance(1 + len(document["numbers"])),
        *([NO_RATIO] if OFF_PATH in document["numbers"] else []),
        *([FAILED_NOTE] if any(failed) else []),
        "",
        _answer(document),
    ]
    return "\n".join(lines)


def cells(document: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the table of the numbers as text, with its head."""
    return [TITLES, *(_row(name, entry) for name, entry in document["numbers"].items())]


def _row(name: str, entry: Mapping[str, Any]) -> tuple[str, ...]:
    factor, unit = _scaled(entry)
    values = [format_number(entry[key] * factor) for key in ("a_median", "b_median", "difference")]
    for place, side in enumerate("ab"):
        values[place] += FAILED_MARK if entry[f"{side}_failed"] else ""
    between = " .. ".join(format_number(bound * factor) for bound in entry["interval"] or ())
    return (
        name,
        *values,
        between or "-",
        f"{entry['lower']} of {entry['count']}",
        *(f"{entry[key]:.2g}" for key in ("p_wilcoxon", "p_holm", "p_sign")),
        *("yes" if entry["decided"] else f"no: {_needed(entry)}", unit),
    )


def lacking_text(entry: tuple[str, Mapping[str, int]]) -> str:
    """Say which flights lack a number: `entry` is its name and an entry of `lacking`."""
    name, counts = entry
    lack = f"flights without it: A {counts['a']}, B {counts['b']}"
    return f"{name}: {lack}; pairs left out: {counts['left_out']}"


def _scaled(entry: Mapping[str, Any]) -> tuple[float, str]:
    return scale(entry["unit"], max(abs(entry["a_median"]), abs(entry["b_median"])))


def _needed(entry: Mapping[str, Any]) -> str:
    needed = entry["pairs_needed"]
    if needed is None:
        return "more pairs needed" if entry["difference"] else "no effect seen"
    return f"about {needed} pairs needed" if needed <= 1000 else "above 1000 pairs needed"


def _answer(document: Mapping[str, Any]) -> str:
    """Say how B changes the first metric, and whether A or B succeeds significantly more often."""
    success, text = document["success"], ""
    if success["decided"]:
        more, less = "ba" if success["b"] > success["a"] else "ab"
        text = (
            f"{more.upper()} succeeds more often: in {success[more]} of {success['count']} flights,"
            f" {less.upper()} in {success[less]}, p = {success['p_mcnemar']:.2g}.\n"
        )
    if not document["numbers"]:
        return f"{text}No pair has one of these metrics; name another with --metric."
    name, entry = next(iter(document["numbers"].items()))
    p, count = f"p = {entry['p_wilcoxon']:.2g}", entry["count"]
    if not entry["decided"]:
        return (
            f"{text}Undecided: {name} after {count} pairs, {p}; {_needed(entry)}.{_caution(entry)}"
        )
    sign, word = (1, "higher") if entry["difference"] > 0 else (-1, "lower")
    factor, unit = _scaled(entry)
    size, low, high = (
        format_number(sign * value * factor)
        for value in (entry["difference"], *entry["interval"][::sign])
    )
    return (
        f"{text}B has a {word} {name}: by {size}{unit and ' '}{unit} ({low} .. {high}), {p}, "
        f"in {entry[word]} of {count} pairs.{_caution(entry)}"
    )


def _caution(entry: Mapping[str, Any]) -> str:
    """Say in a sentence, after a space, if the sign test does not confirm the answer."""
    if entry["decided"] and entry["p_sign"] >= LEVEL:
        return (
            " This holds if the differences are symmetric; the sign test, which does not assume "
            f"it, does not confirm it (p = {entry['p_sign']:.2g})."
        )
    return ""
