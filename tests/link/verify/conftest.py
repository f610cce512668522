# SPDX-License-Identifier: Apache-2.0

"""Probes and flights over links in virtual time, shaped as by the relay or by netem."""

from dataclasses import replace
from functools import cache

import numpy as np

from cloudrc.config.profile import load_profile
from cloudrc.flight.pod.link_monitor import LinkMonitor
from cloudrc.link.model import LinkDirection
from cloudrc.link.traces import link_profile
from cloudrc.link.verify.causes import Findings
from cloudrc.link.verify.judge import Flow, netem_makes
from cloudrc.link.verify.probe import PROBE, plan_probes
from cloudrc.wire.records import Arrival, Fault, LinkChecked
from cloudrc.wire.tunnel.codec import SIZES, Kind
from tests.link.profiles import in_bursts, profile_of


def asked(name, way):
    """Return one direction of a shipped profile."""
    return link_profile(getattr(load_profile(name), way))


SEED, KINDS = 1, {True: Kind.TELEMETRY, False: Kind.COMMAND}
PERIOD_NS = 10_000_000
plan_of = cache(plan_probes)
OVERHEAD = 8e-5
"""Delay that a good relay and the network stack add [s]."""


def rows_of(profile, real, *, stall=0.0, netem=False):
    """Request `profile`, probe a link that has the profile `real`, and judge it.

    30 % of the probes are up to `stall` [s] late, as with a relay without CPU time. With `netem`,
    the random numbers do not follow the experiment's seed.
    """
    flow = Flow(SEED, True, PROBE, SIZES[Kind.TELEMETRY])
    plan = plan_of(profile, flow, drawn=netem)
    link = replace(plan, profile=real)
    if netem:
        link = replace(link, profile=netem_makes(real), flow=flow._replace(seed=2))
    stream = link.draw(plan.sent)
    rng = np.random.default_rng(SEED)
    late = stall * rng.random(len(stream.sent)) * (rng.random(len(stream.sent)) < 0.3)
    return plan.judge(replace(stream, delays=stream.delays + OVERHEAD + late))


def verify(profile, up, down, known):
    """Request a profile in both directions, and probe links with the profiles `up` and `down`."""
    ways = {"uplink": up, "downlink": down}
    return {way: Findings(rows_of(profile, one), known) for way, one in ways.items()}


def arrivals(profile, seconds=60.0, *, seed=SEED, overhead=5e-4, uplink=False):
    """Return the arrivals that cloud (`uplink`) or world records in a flight of `seconds` [s].

    The ends add `overhead` [s]; NaN: they share no clock. The experiment's seed is 1.
    """
    link, found = LinkDirection(profile, seed, uplink=uplink), []
    kind, whole = KINDS[uplink], bytes(SIZES[KINDS[uplink]])
    for n in range(round(seconds * 100)):
        sent_ns = n * PERIOD_NS
        arrivals = link.send(1, kind, n, len(whole), sent_ns)
        if link.corrupts and link.corrupted(1, kind, n, whole) != whole:
            continue
        for at_ns in arrivals:
            delay = (at_ns - sent_ns) * 1e-9 + overhead
            found.append(Arrival(at_ns, uplink, 1, n, delay, True))
    return sorted(found)


def hearing(up, down, *, uplink=False):
    """Return the monitor of the end that receives a direction."""
    flow = Flow(SEED, uplink, KINDS[uplink], SIZES[KINDS[uplink]])
    monitor = LinkMonitor(uplink, flow, period=0.01, computes=False, file_max=1000)
    monitor.follow((up, down))
    return monitor


def checked(monitor, records):
    """Pass records one by one; return the rows of each verdict by quantity, and the faults."""
    moments, faults = list[dict[str, LinkChecked]](), list[Fault]()
    for record in records:
        told = monitor.after([record], record.stamp_ns)
        rows = {one.quantity: one for one in told if isinstance(one, LinkChecked)}
        moments += [rows] if rows else []
        faults += [one for one in told if isinstance(one, Fault)]
    return moments, faults


def is_verified(moment):
    return {row.verdict for row in moment.values()} - {"told"} == {"ok"}


def random_profile(rng):
    """Draw a profile that a user might write."""

    def one_of(*values):
        return values[rng.integers(len(values))]

    delay, is_queue = float(rng.uniform(5e-3, 0.15)), rng.random() < 0.3
    bursts = in_bursts(float(rng.uniform(1e-3, 0.01)), float(rng.uniform(0.2, 0.6)))
    return profile_of(
        delay,
        min(0.01 if is_queue else 0.03, float(rng.uniform(0.0, 0.4)) * delay),
        one_of("uniform", "normal", "pareto"),
        one_of(0.0, 0.0, 0.4),
        one_of(0.0, float(rng.uniform(0.0, 0.1)), bursts),
        duplicate=one_of(0.0, 0.0, 0.0, 0.05),
        reorder=0.0 if is_queue else one_of(0.0, 0.0, 0.2),
        corrupt=one_of(0.0, 0.0, 0.0, 0.1),
        keep_order=is_queue,
        rate=one_of(None, float(rng.uniform(1e6, 2e7))) if is_queue else None,
    )
