"""The verdict in words: what happened on this flight, for somebody who reads only one paragraph."""

from __future__ import annotations

from collections.abc import Mapping

from cloudrc.metrics import Flight, Number
from cloudrc.report.verdict import Verdict

HEADLINES = {
    "success": "The mission succeeded.",
    "failure": "The mission failed.",
    "invalid": "The run is invalid: it did not keep real time.",
    "interrupted": "The run was interrupted.",
}


def headline(verdict: Verdict) -> str:
    """Say in one short sentence what became of the run."""
    return HEADLINES[verdict.outcome]


def summary(flight: Flight, numbers: Mapping[str, Number]) -> str:
    """Say in a few sentences what happened, with what is known of it."""
    if flight.start_ns is None:
        return "The robot never left the ground."
    known = {name: number.value for name, number in numbers.items()}
    parts = [
        _waypoints(flight, known),
        _pipes(flight, known),
        _contact(flight, known),
        _link(known),
        _guard(known),
    ]
    return " ".join(part for part in parts if part)


def _waypoints(flight: Flight, known: Mapping[str, float]) -> str:
    reached = f"{known.get('waypoints_reached', 0):.0f}"
    took = f" in {known['duration']:.1f} s" if "duration" in known else ""
    far = f", {known['distance_flown']:.1f} m" if "distance_flown" in known else ""
    count = flight.waypoints
    if reached == str(count):
        goal = "its waypoint" if count == 1 else f"all {count} waypoints"
    else:
        goal = f"{reached} of {count} waypoints"
    return f"The drone reached {goal}{took}{far}."


def _pipes(flight: Flight, known: Mapping[str, float]) -> str:
    flown = flight.pipes_flown
    if not flown or "min_clearance" not in known:
        return ""
    pipes = "one pipe" if flown == 1 else f"{flown} pipes"
    touched = known.get("pipe_contacts", 0)
    if touched:
        times = "once" if touched == 1 else f"{touched:.0f} times"
        return f"It flew through {pipes} and touched a wall {times}."
    nearest = known["min_clearance"] * 1e3
    return f"It flew through {pipes}, never nearer than {nearest:.0f} mm to a wall."


def _contact(flight: Flight, known: Mapping[str, float]) -> str:
    if "contact_time" not in known or "tip_speed" not in known:
        return "It never touched the board." if flight.criteria.contact else ""
    text = (
        f"Its arm touched the board after {known['contact_time']:.1f} s "
        f"at {known['tip_speed']:.2f} m/s"
    )
    if "steady_contact_force" in known:
        text += f" and then pressed on it with {known['steady_contact_force']:.2f} N"
    return text + "."


def _link(known: Mapping[str, float]) -> str:
    if "prediction_error_rms" not in known or "rtt_mean" not in known:
        return ""
    return (
        f"The round trip took {known['rtt_mean'] * 1e3:.0f} ms on average; the remote controller "
        f"predicted where its commands would act to within "
        f"{known['prediction_error_rms'] * 1e3:.0f} mm (RMS)."
    )


def _guard(known: Mapping[str, float]) -> str:
    if "hold_count" not in known:
        return ""
    count = known["hold_count"]
    if not count:
        return "The guard on board never had to take over."
    times = "once" if count == 1 else f"{count:.0f} times"
    return f"The guard on board took over {times}, for {known.get('hold_time', 0):.1f} s in all."
