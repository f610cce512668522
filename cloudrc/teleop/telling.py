# SPDX-License-Identifier: Apache-2.0

"""Describe missions and the robot for people, from answers of teleop's API."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cloudrc.base.text import describe_point, describe_sensors, table
from cloudrc.teleop.client import describe_verdict


def missions_table(missions: Sequence[Mapping[str, Any]]) -> str:
    """Return a table with a row per mission."""
    rows = [("ID", "NAME", "STATE", "WAYPOINTS", "VERDICT")]
    for each in missions:
        done = f"{len(each['reached'])}/{each['waypoints']}" if each["waypoints"] else "-"
        verdict = describe_verdict(each["verdict"]) if each["verdict"] else ""
        rows.append((each["id"], each["name"], each["state"], done, verdict))
    return table(rows)


def describe_robot(seen: Mapping[str, Any] | None, cloud_age: float | None) -> Iterator[str]:
    """Describe the robot's newest known state in lines.

    `seen` is that of the state of the API; `cloud_age` is the age of cloud's last message [s].
    """
    heard = "never" if cloud_age is None else f"{cloud_age:.1f} s ago"
    if seen is None:
        yield f"no telemetry from the robot yet; last message from cloud: {heard}"
        return
    where = describe_point(seen["position_m"])
    if seen["guard_for_s"] is None:
        yield f"no telemetry for {seen['age_s']:.1f} s; last message from cloud: {heard}"
        yield (
            f"last seen {seen['age_s']:.1f} s ago at {where} m, with the guard in {seen['guard']}: "
            f"{seen['cause']}"
        )
    else:
        rtt = "" if seen["rtt_s"] is None else f", round trip {seen['rtt_s'] * 1e3:.0f} ms"
        yield f"robot at {where} m, seen {seen['age_s']:.2f} s ago{rtt}"
        yield f"guard {seen['guard']} for {seen['guard_for_s']:.1f} s: {seen['cause']}"
        if shown := describe_sensors(seen["sensors"]):
            yield f"sensors: {shown}"
    yield f"next: {seen['next_step']}"


def describe_stay(state: Mapping[str, Any]) -> str:
    """Describe where the robot stays after a command, or which mission it flies now."""
    mission, seen = state["mission"], state["seen"]
    if mission is not None and mission["state"] != "held":
        return f"mission {mission['id']} continues"
    if seen is not None and seen["guard"] == "GROUND":
        return "waiting on the ground"
    return f"holding at {describe_point(seen['position_m'])}" if seen is not None else "holding"


def describe_history(mission: Mapping[str, Any]) -> Iterator[str]:
    """Describe the events of a mission, one per line."""
    if left_out := mission.get("events_left_out", 0):
        yield f"{mission['id']:<4}{left_out} earlier events are not shown"
    yield from map(describe_event, mission["events"])


def describe_event(event: Mapping[str, Any]) -> str:
    """Describe an event of a mission in one line."""
    return f"{event['mission']:<4}{event['time_s']:8.2f} s  {event['text']}"
