"""How often something went wrong that did not stop the flight: a predictor that raised, a clamp."""

from __future__ import annotations

from cloudrc.metrics import Flight

UNIT = "1"
FAILURES = ("estimator_failed", "predictor_failed", "controller_failed", "horizon_clamped")


def measure(flight: Flight) -> float | None:
    """Failures counted by cloud, and what else was noted as a fault [1]; None if nothing flew.

    A fault that repeats is noted once, as a record, and counted every time.
    """
    if flight.start_ns is None:
        return None
    count, faults = flight.recording["/count"], flight.recording["/fault"]["code"]
    totals = dict.fromkeys(FAILURES, 0)
    for name, total in zip(count["name"], count["total"], strict=True):
        if name in totals:
            totals[name] = max(totals[name], int(total))
    for code in faults:
        totals[code] = max(totals.get(code, 0), 1)
    return float(sum(totals.values()))
