"""What a link's process tells whoever judges it: who shapes, what is in force, whose netem is near.

It is found out when somebody asks (/link.json of the metrics' port): tc and ip are started for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter

from cloudrc.errors import CloudrcError
from cloudrc.link.netem_tc import Iproute2, Run
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import Timeline, settled


@dataclass(frozen=True, slots=True)
class Near:
    """The netem qdiscs of a network namespace, whoever put them there.

    Attributes:
        interface: Over which the tunnel's flow leaves.
        netems: By interface: objects of `tc -s -j qdisc show`; only where there are any.
    """

    interface: str
    netems: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class Told:
    """What a link's process says of the direction that it shapes.

    Attributes:
        shaper: "relay" or "netem".
        why: Why this one, in words.
        applied: What it was told to put in force and has; None while a time line runs.
        near: What the kernel says; None where that cannot be asked.
    """

    shaper: str
    why: str
    applied: DirectionProfile | None
    near: Near | None = None


def look_near(run: Run, host: str) -> Near | None:
    """Ask the kernel for its netems, and for the way to a host; None if it cannot be asked."""
    iproute2, netems = Iproute2(run), dict[str, list[dict[str, Any]]]()
    try:
        interface = iproute2.device(host)
        for one in iproute2.show("qdisc", "show"):
            if one.get("kind") == "netem":
                netems.setdefault(str(one["dev"]), []).append(one)
    except (CloudrcError, ValueError, LookupError):
        return None
    return Near(interface, netems)


def in_force_now(profile: DirectionProfile, elapsed_ns: int) -> DirectionProfile | None:
    """Say what holds so long [ns] after the link came up, if it holds for ever; else None."""
    return settled(profile) if elapsed_ns >= Timeline(profile).starts_ns[-1] else None


def write_told(told: Told) -> str:
    """Write it as JSON."""
    return TypeAdapter(Told).dump_json(told, indent=2).decode() + "\n"


def read_told(text: str) -> Told:
    """Read it; raises a ValueError if it is something else."""
    return TypeAdapter(Told).validate_json(text)
