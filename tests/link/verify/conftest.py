"""Links in virtual time: probes and flights over the model, or over netem as the kernel draws.

Source: Linux, net/sched/sch_netem.c: get_crandom, tabledist, loss_gilb_ell, netem_enqueue.
"""

import random
from dataclasses import replace

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.link.model import LinkDirection, Stream
from cloudrc.link.netem import check, stretch, table
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from cloudrc.link.verify.causes import Findings
from cloudrc.link.verify.judge import Flow
from cloudrc.link.verify.monitor import LinkMonitor
from cloudrc.link.verify.probe import PROBE, plan_probes
from cloudrc.records import Arrival, Fault, LinkChecked
from cloudrc.tunnel.codec import SIZES, Kind

_WORDS, _ONE = 1 << 32, 8192
_HEADERS = 28
_IN_ORDER = 100e9


class VirtualNetem:
    """Shape one direction as `sch_netem.c` does, without time lines; used like `LinkDirection`."""

    def __init__(self, profile, seed):
        check(profile)
        self._profile, self._chance = profile, random.Random(seed)
        self._rho = round(profile.correlation * (_WORDS - 1))
        self._last_draw = self._chance.getrandbits(32)
        self._bad, self._last_ns = False, 0
        self._table = table(profile.distribution)

    def send(self, epoch, kind, counter, size, now_ns):
        """Return when the copies of a packet arrive [ns]."""
        return [at_ns for at_ns in self._enqueue(size, now_ns, self._profile.duplicate) if at_ns]

    def _enqueue(self, size, now_ns, duplicate):
        profile = self._profile
        count = 1 + (self._chance.random() < duplicate) - self._loses()
        if count == 0:
            return []
        # The copy goes through all of it once more.
        found = self._enqueue(size, now_ns, 0.0) if count > 1 else []
        damaged = self._chance.random() < profile.corrupt
        at_ns = now_ns + round((profile.delay + self._jitter()) * 1e9)
        if rate := profile.rate or (_IN_ORDER if profile.keep_order else None):
            at_ns = max(at_ns, now_ns, self._last_ns) + round((size + _HEADERS) * 8e9 / rate)
            self._last_ns = at_ns
        return [*found, None if damaged else max(now_ns, at_ns)]

    def _loses(self):
        loss = self._profile.loss
        if not isinstance(loss, GilbertElliott):
            return self._chance.random() < loss
        share = loss.loss_bad if self._bad else loss.loss_good
        if self._chance.random() < (loss.bad_end if self._bad else loss.bad_start):
            self._bad = not self._bad
        return self._chance.random() < share

    def _jitter(self):
        """Draw a number of which only the high bits are correlated."""
        drawn = self._chance.getrandbits(32)
        if self._rho:
            rho = self._rho + 1
            drawn = (drawn * (_WORDS - rho) + self._last_draw * rho) >> 32
            self._last_draw = drawn
        unit = self._profile.jitter * stretch(self._profile) / _ONE
        return unit * self._table[drawn % len(self._table)]


def asked(name, way):
    """Return one direction of a shipped profile."""
    return link_profile(getattr(load_profile(name), way))


SEED, KINDS = 1, {True: Kind.TELEMETRY, False: Kind.COMMAND}
PERIOD_NS = 10_000_000
OVERHEAD = 8e-5
"""Delay that a good relay and the network stack add [s]."""


def rows_of(profile, real, *, stall=0.0, seconds=None):
    """Probe a link; a relay without CPU delays 30 % of the probes by up to `stall` [s]."""
    netem = isinstance(real, VirtualNetem)
    plan = plan_probes(
        profile, Flow(SEED, True, PROBE, SIZES[Kind.TELEMETRY]), seconds, drawn=netem
    )
    stream = meet(plan, real)
    rng = np.random.default_rng(SEED)
    late = stall * rng.random(len(stream.sent)) * (rng.random(len(stream.sent)) < 0.3)
    stream = replace(stream, delays=stream.delays + OVERHEAD + late)
    return plan.judge(stream)


def meet(plan, real):
    """Return what a link does to the datagrams of a plan."""
    if not isinstance(real, VirtualNetem):
        return replace(plan, profile=real).draw(plan.sent)
    sent_ns = np.rint(plan.sent * 1e9).astype(np.int64).tolist()
    fates = [real.send(1, PROBE, n, plan.flow.size, at_ns) for n, at_ns in enumerate(sent_ns)]
    pairs = zip(fates, sent_ns, strict=True)
    delays = [(min(fate) - at_ns) * 1e-9 if fate else np.nan for fate, at_ns in pairs]
    return Stream(plan.sent, np.array(delays), np.array([len(fate) for fate in fates]))


def verify(profile, up, down, known):
    """Request a profile both ways and find another one in each."""
    ways = {"uplink": up, "downlink": down}
    return {way: Findings(rows_of(profile, one), known) for way, one in ways.items()}


def arrivals(profile, seconds=60.0, *, seed=SEED, overhead=5e-4, uplink=False, netem=False):
    """Return what cloud (`uplink`) or world notes of a flight of some seconds.

    The ends add `overhead` [s]; NaN: they share no clock. The experiment's seed is 1.
    """
    model = LinkDirection(profile, seed, uplink=uplink)
    link = VirtualNetem(profile, seed) if netem else model
    kind, size, found = KINDS[uplink], SIZES[KINDS[uplink]], []
    for n in range(round(seconds * 100)):
        sent_ns = n * PERIOD_NS
        fate = link.send(1, kind, n, size, sent_ns)
        whole = bytes(size)
        if link is model and model.corrupts and model.corrupted(1, kind, n, whole) != whole:
            continue
        for at_ns in fate:
            delay = (at_ns - sent_ns) * 1e-9 + overhead
            found.append(Arrival(at_ns, uplink, 1, n, delay, True))
    return sorted(found)


def hearing(up, down, *, uplink=False):
    """Return the monitor of the end that receives a direction."""
    flow = Flow(SEED, uplink, KINDS[uplink], SIZES[KINDS[uplink]])
    monitor = LinkMonitor(uplink=uplink, flow=flow)
    monitor.follow((up, down))
    return monitor


def checked(monitor, records, since_ns=0):
    """Pass records one by one; return the rows of each verdict by quantity, and the faults."""
    moments, faults = list[dict[str, LinkChecked]](), list[Fault]()
    for record in records:
        told = monitor.after([record], record.stamp_ns + since_ns)
        rows = {one.quantity: one for one in told if isinstance(one, LinkChecked)}
        moments += [rows] if rows else []
        faults += [one for one in told if isinstance(one, Fault)]
    return moments, faults


def is_believed(moment):
    return {row.verdict for row in moment.values()} - {"told"} == {"ok"}


def random_profile(rng):
    """Draw a profile that a user might write."""
    delay = float(rng.uniform(5e-3, 0.15))
    profile = DirectionProfile(
        delay,
        min(0.03, float(rng.uniform(0.0, 0.4)) * delay),
        str(rng.choice(["uniform", "normal", "pareto"])),
    )
    if rng.random() < 0.3:
        profile = replace(profile, correlation=float(rng.uniform(0.1, 0.6)))
    if rng.random() < 0.3:
        profile = replace(profile, keep_order=True, jitter=min(0.01, profile.jitter))
    elif rng.random() < 0.3:
        profile = replace(profile, reorder=float(rng.uniform(0.01, 0.3)))
    if rng.random() < 0.2:
        profile = replace(profile, duplicate=float(rng.uniform(0.01, 0.1)))
    if rng.random() < 0.2:
        profile = replace(profile, corrupt=float(rng.uniform(0.001, 0.2)))
    if rng.random() < 0.2:
        rate = float(rng.uniform(1e6, 2e7))
        return replace(profile, rate=rate, keep_order=True, jitter=min(0.01, profile.jitter))
    if rng.random() < 0.3:
        bursts = GilbertElliott(float(rng.uniform(1e-3, 0.01)), float(rng.uniform(0.2, 0.6)))
        return replace(profile, loss=bursts)
    if rng.random() < 0.6:
        return replace(profile, loss=float(rng.uniform(0.0, 0.1)))
    return profile
