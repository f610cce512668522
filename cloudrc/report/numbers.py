"""Lay out the report's table of numbers: rows in groups, in readable units."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from cloudrc.metrics import Number

GROUPS: dict[str, tuple[str, ...]] = {
    "Mission": (
        "duration",
        "waypoints_reached",
        "distance_flown",
        "speed_max",
        "contact_time",
        "tip_speed",
        "peak_contact_force",
        "steady_contact_force",
        "steady_error_x",
        "steady_error_y",
        "steady_error_z",
    ),
    "Distance to the pipes": ("min_clearance", "min_clearance_flight", "pipe_contacts"),
    "Estimation and tracking": (
        "prediction_error_rms",
        "estimate_error_rms",
        "delay_estimate_error_rms",
        "tracking_rms_measured",
        "tracking_rms_estimated",
    ),
    "Link and loop": (
        "uplink_delay_mean",
        "downlink_delay_mean",
        "loss_uplink",
        "loss_downlink",
        "late_uplink",
        "late_downlink",
        "rtt_mean",
        "rtt_p95",
        "loop_delay_mean",
        "age_of_information_mean",
        "commands_applied",
    ),
    "Guard and faults": ("hold_count", "hold_time", "fault_count", "recorder_dropped"),
    "Real time": (
        "real_time_factor",
        "world_slip",
        "world_lateness_p99",
        "cloud_lateness_p99",
        "missed_periods",
    ),
}
"""Groups of the table, in order; metrics in no group come last, under "Others"."""
SHARES = ("loss_", "late_")
"""Prefixes of the names of numbers that are shown in per cent."""


def table_rows(numbers: Mapping[str, Number]) -> str:
    """Lay out the table's body as HTML, a `tbody` for each group that has numbers."""
    grouped = {name for names in GROUPS.values() for name in names}
    groups = {**GROUPS, "Others": tuple(name for name in numbers if name not in grouped)}
    bodies = []
    for title, names in groups.items():
        known = [name for name in names if name in numbers]
        if known:
            cells = "\n".join(_row(name, numbers[name]) for name in known)
            head = f'<tr><th scope="rowgroup" colspan="4">{escape(title)}</th></tr>'
            bodies.append(f"<tbody>\n{head}\n{cells}\n</tbody>")
    return "\n".join(bodies)


def readable(name: str, number: Number) -> tuple[str, str]:
    """Format a number in a readable unit; return the digits and the unit."""
    value, unit = number.value, number.unit
    if value == 0:
        return "0", "" if unit == "1" else unit
    if unit == "1":
        if name.startswith(SHARES):
            return f"{value * 100:.2f}", "%"
        return (f"{value:.0f}" if value.is_integer() else f"{value:.4g}"), ""
    if unit in ("s", "m") and abs(value) < (1.0 if unit == "s" else 0.1):
        return _digits(value * 1e3), f"m{unit}"
    return _digits(value), unit


def _digits(value: float) -> str:
    """Format with four significant digits, at most three decimals: 27.60, 0.237, 16.99."""
    places = 3 if abs(value) < 1 else 3 - len(str(int(abs(value)))) + 1
    return f"{value:.{max(places, 0)}f}"


def _row(name: str, number: Number) -> str:
    digits, unit = readable(name, number)
    return (
        f"<tr><td><code>{escape(name)}</code></td>"
        f'<td class="value">{escape(digits)}</td><td class="unit">{escape(unit)}</td>'
        f"<td>{escape(number.meaning)}</td></tr>"
    )
