"""Compare two settings, A and B, by pairs of flights that differ in nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from statistics import median
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.plugins import unknown_name_text
from cloudrc.sweep.flight import Outcome
from cloudrc.sweep.statistics import LEVEL, paired, sign_test, wilson_interval

NUMBERS = (
    *("prediction_error_rms", "tracking_error_p95", "iae_mean", "settling_time_mean"),
    *("overshoot_mean", "delay_estimate_error_rms", "min_clearance"),
)
"""Metrics that are compared by default; the first one that the flights have is the answer."""
METHOD = (
    "B - A: Hodges-Lehmann estimate, 95 % interval and p of the exact Wilcoxon signed-rank test; "
    "success: Wilson intervals, p of the exact McNemar test"
)


class Pair(NamedTuple):
    """Two flights that differ in the compared setting only."""

    label: Mapping[str, Any]  # what both share, such as the seed
    a: Outcome
    b: Outcome


def compare(pairs: Sequence[Pair], names: Sequence[str] = ()) -> dict[str, Any]:
    """Evaluate success and the metrics `names` (default: `NUMBERS`); return a JSON document.

    A pair with a flight that was invalid, interrupted or ended with an error is left out. Where one
    flight of a pair lacks a metric, the pair is left out for this metric.

    Raises:
        BadInputError: If no pair counts, or if no pair has a metric of `names`.
    """
    flown = [pair for pair in pairs if {pair.a.verdict, pair.b.verdict} <= {"success", "failure"}]
    if not flown:
        texts = [flight.text for pair in pairs for flight in pair[1:] if flight.text]
        why = f"each has a flight that did not end: {texts[0]}" if texts else "none was found"
        raise BadInputError(f"no pair of flights to compare: {why}")
    known = sorted({name for pair in flown for name in pair.a.numbers.keys() & pair.b.numbers})
    for name in names:
        if name not in known:
            raise BadInputError(f"--number: {unknown_name_text('number', name, known)}")
    chosen = names or [name for name in NUMBERS if name in known]
    return {
        "pairs": len(flown),
        "left_out": len(pairs) - len(flown),
        "success": _success(flown),
        "numbers": {name: _number(flown, name) for name in chosen},
        "method": METHOD,
        "flights": [
            {**label, "a": _flight(a, chosen), "b": _flight(b, chosen)} for label, a, b in pairs
        ],
    }


def _number(pairs: Sequence[Pair], name: str) -> dict[str, Any]:
    both = [(a.numbers[name], b.numbers[name]) for _, a, b in pairs
            if name in a.numbers and name in b.numbers]  # fmt: skip
    return {
        "unit": both[0][0].unit,
        "a_median": median(a.value for a, _ in both),
        "b_median": median(b.value for _, b in both),
        **asdict(paired([b.value - a.value for a, b in both])),
        "left_out": len(pairs) - len(both),
    }


def _success(pairs: Sequence[Pair]) -> dict[str, Any]:
    done, count = (
        [(a.verdict == "success", b.verdict == "success") for _, a, b in pairs],
        len(pairs),
    )
    a, b = (sum(each) for each in zip(*done, strict=True))
    only_a = sum(a and not b for a, b in done)
    only_b = b - (a - only_a)
    p = sign_test(only_a, only_b)
    return {
        **{"count": count, "a": a, "a_interval": wilson_interval(a, count)},
        **{"b": b, "b_interval": wilson_interval(b, count)},
        **{"only_a": only_a, "only_b": only_b, "p_mcnemar": p, "decided": p < LEVEL},
    }


def _flight(flight: Outcome, names: Sequence[str]) -> dict[str, Any]:
    numbers = {name: flight.numbers[name].value for name in names if name in flight.numbers}
    return {"verdict": flight.verdict, "numbers": numbers}


def scale(unit: str, largest: float) -> tuple[float, str]:
    """Return factor and unit in which values up to `largest` [`unit`] are readable: mm, ms."""
    if 0 < largest < {"m": 0.1, "s": 1.0}.get(unit, 0.0):
        return 1e3, f"m{unit}"
    return 1.0, "" if unit == "1" else unit
