"""What a release costs: the kubelet's own counters, read twice; and how fast the machine is."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from functools import cache

from kube import NAMESPACE, command, eventually, kubectl, pod
from pace import WORK, slower


@dataclass
class Cost:
    """Processor [cores] and memory [bytes]: in all, and of each container."""

    cpu: float
    memory: float
    containers: dict[str, tuple[float, float]]


Usage = dict[str, tuple[float, float, float]]
"""Container -> instant [s], processor time used so far [s], memory [bytes]."""


def usage() -> Usage:
    """Read the counters of all containers of the release."""
    found: Usage = {}
    for component in ("world", "cloud"):
        one = pod(component)
        summary = json.loads(command("kubectl", "get", "--raw", _address(one["spec"]["nodeName"])))
        (mine,) = [
            each
            for each in summary["pods"]
            if each["podRef"]["uid"] == one["metadata"]["uid"]
            and each["podRef"]["namespace"] == NAMESPACE
        ]
        for container in mine["containers"]:
            cpu = container["cpu"]
            found[f"{component}/{container['name']}"] = (
                datetime.fromisoformat(cpu["time"].replace("Z", "+00:00")).timestamp(),
                cpu["usageCoreNanoSeconds"] * 1e-9,
                container["memory"]["workingSetBytes"],
            )
    return found


def cost_between(before: Usage, after: Usage) -> Cost:
    """What was used per second from one reading to a later one."""
    newest = after if _is_later(after, before) else later(before)
    containers = {
        name: ((used - before[name][1]) / (at - before[name][0]), memory)
        for name, (at, used, memory) in newest.items()
        if name in before
    }
    cpu, memory = (sum(each[i] for each in containers.values()) for i in (0, 1))
    return Cost(cpu, memory, containers)


def later(before: Usage) -> Usage:
    """Read the counters once the kubelet has measured all containers again."""

    def look() -> Usage | None:
        now = usage()
        return now if _is_later(now, before) else None

    found: Usage = eventually(look, "the kubelet has measured again", 30.0)
    return found


@cache  # measured where the release flies; later its pods may just be replaced
def pace() -> float:
    """How much slower than nominal the release's own interpreter is at its own work; at least 1."""
    words = ("exec", pod("world")["metadata"]["name"], "--container=world", "--")
    return slower(kubectl(*words, "python", "-c", WORK))


def _is_later(one: Usage, other: Usage) -> bool:
    return all(one[name][0] > other[name][0] for name in other)


def _address(node: str) -> str:
    return f"/api/v1/nodes/{node}/proxy/stats/summary"
