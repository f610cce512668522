"""What a shaper tells of itself, read back: its state, its metrics, the kernel's qdiscs.

Nothing is assumed: what cannot be read is not known.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cloudrc.link.netem_tables import stretch
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss
from cloudrc.link.sidecar_told import Near, Told
from cloudrc.link.verify_causes import Evidence

_IN_ORDER = 50e9
"""A rate above this [bit/s] is there to keep the order, and limits nothing."""
_SAMPLE = re.compile(r"^(?P<name>\w+)(?:\{(?P<labels>[^}]*)\})? (?P<value>\S+)$", re.MULTILINE)

Samples = Mapping[tuple[str, str], float]
"""Values of metrics by name and by their labels as they are written: 'outcome="lost"'."""


def samples(text: str) -> Samples:
    """Read Prometheus' text; values of any unit."""
    return {
        (found["name"], found["labels"] or ""): float(found["value"])
        for found in _SAMPLE.finditer(text)
    }


def shaper_of(found: Samples, way: str) -> str:
    """Say who shapes a direction by the link's metrics; "" if they do not tell."""
    for (name, labels), value in found.items():
        if name == "cloudrc_link_info" and f'direction="{way}"' in labels and value:
            match = re.search(r'shaper="(\w+)"', labels)
            return match[1] if match else ""
    return ""


def of_metrics(
    found: Samples, sent: int, evidence: Evidence, before: Samples | None = None
) -> Evidence:
    """Add to what is known what the link's metrics say.

    Args:
        found: After the last probe.
        sent: Datagrams that this end has sent.
        evidence: What is known so far.
        before: Before the first probe, of a link that was there already: of stops and of
            qdiscs put back only those since then tell of these probes.
    """

    def since(name: str) -> float:
        now, then = found.get((name, ""), 0.0), (before or {}).get((name, ""), 0.0)
        return now - then if now >= then else now  # a link that was restarted counts from 0

    # The relay counts what came in; netem what it sent on and what it dropped.
    received = found.get(("cloudrc_link_datagrams_total", 'outcome="received"'))
    if evidence.shaper == "netem":
        kinds = ("forwarded", "lost", "held")
        counts = [
            found.get(("cloudrc_link_datagrams_total", f'outcome="{kind}"')) for kind in kinds
        ]
        received = sum(count or 0.0 for count in counts)
    unread = found.get(("cloudrc_link_datagrams_total", 'outcome="unread"'))
    late = found.get(("cloudrc_link_release_error_seconds", 'percentile="99"'))
    periods = since("cloudrc_cpu_periods_total")
    share = since("cloudrc_cpu_throttled_periods_total") / periods if periods > 0 else None
    passed = None if received is None else int(received)
    missed = None if unread is None else int(unread)
    known = replace(evidence, sent=sent, passed=passed, unread=missed)
    restored = int(since("cloudrc_link_restored_total"))
    return replace(known, late=late, throttled=share, restored=restored)


Qdiscs = Mapping[str, Sequence[Mapping[str, Any]]]
"""Objects of `tc -s -j qdisc show`, by interface."""


def of_qdiscs(listed: Qdiscs, interface: str) -> Evidence:
    """Say what shapes a flow by the qdiscs of a network namespace.

    Args:
        listed: All of them.
        interface: Over which the flow leaves.
    """
    netems = {name: _netems(qdiscs) for name, qdiscs in listed.items()}
    here = netems.get(interface, [])
    elsewhere = tuple(name for name, found in netems.items() if found and name != interface)
    counts = [int(one.get("packets", 0)) + int(one.get("drops", 0)) for one in here]
    return Evidence(
        shaper="netem" if here else "none",
        interface=interface,
        elsewhere=elsewhere,
        layers=len(here) or None,
        passed=max(counts, default=None),
    )


def in_force(found: Evidence, listed: Qdiscs, told: Evidence) -> Evidence:
    """Join what the kernel says with what the shaper's process says of itself.

    Args:
        found: From `of_qdiscs`.
        listed: What that was made from.
        told: By the process: what it was asked to put in force.
    """
    qdiscs = _netems(listed.get(found.interface, []))
    applied = told.applied
    if applied is not None and qdiscs:
        applied = netem_profile(qdiscs[-1].get("options", {}), applied)
    return replace(
        found,
        why=told.why,
        applied=applied if qdiscs else None,
        sent=told.sent,
        throttled=told.throttled,
        restored=told.restored,
    )


def of_told(told: Told) -> Evidence:
    """Say what a link's process tells, of itself and of the kernel."""
    known = Evidence(told.shaper, told.why, layers=1, applied=told.applied)
    return with_near(known, told.near)


def with_near(told: Evidence, near: Near | None) -> Evidence:
    """Add to what a shaper tells of itself which netems are on the flow's way, if that is known."""
    if near is None:
        return told
    if told.shaper == "netem":
        return in_force(of_qdiscs(near.netems, near.interface), near.netems, told)
    way = {_TO_RELAY, near.interface}
    others = sum(len(near.netems.get(name, ())) for name in way)
    return replace(told, interface=near.interface, layers=1 + others)


_TO_RELAY = "lo"
"""Over which an end reaches the relay of its pod."""


def netem_profile(options: Mapping[str, Any], told: DirectionProfile) -> DirectionProfile:
    """Put the options of a netem, as tc prints them, in place of the numbers of a profile.

    Args:
        options: Times in [s], chances in [0, 1], rate in [byte/s]; what is not there is 0.
        told: Says what the options leave open: distribution, order, what changes later.
    """
    delay = options.get("delay", {})
    loss: Loss = float(options.get("loss-random", {}).get("loss", 0.0))
    chain = options.get("loss-gemodel")
    if chain:
        p, r, good, bad = (float(chain.get(key, 0.0)) for key in ("p", "r", "1-k", "1-h"))
        loss = GilbertElliott(p, r, bad, good)
    rate = 8.0 * float(options.get("rate", {}).get("rate", 0.0))
    return replace(
        told,
        delay=float(delay.get("delay", 0.0)),
        jitter=float(delay.get("jitter", 0.0)) / stretch(told),
        loss=loss,
        duplicate=float(options.get("duplicate", {}).get("duplicate", 0.0)),
        reorder=float(options.get("reorder", {}).get("reorder", 0.0)),
        corrupt=float(options.get("corrupt", {}).get("corrupt", 0.0)),
        rate=rate if 0.0 < rate < _IN_ORDER else None,
        keep_order=rate > 0.0,
    )


def _netems(qdiscs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [one for one in qdiscs if one.get("kind") == "netem"]
