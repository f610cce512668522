# SPDX-License-Identifier: Apache-2.0

"""Shape one direction of the link in the kernel: `tc` configures the pod's outgoing interface.

    interface > prio 7400: --+-- bands 1-3: everything else, as before
                             +-- band 4 > netem 7401: datagrams that the filter selects:
                                          only UDP to the peer's tunnel port

After a restart, `Netem` finds its qdiscs by their handles. In flight it changes them with `tc qdisc
change`, which keeps queued packets. An option that is missing in this command keeps its old value,
so every call contains all options.

netem draws jitter from a table of 16-bit integers, in which 8192 stands for one times the jitter.
The tables of tc differ from the distributions of the link's model, so `write_table` writes its own.

Source: tc-prio(8), tc-netem(8), tc-u32(8); iproute2 netem/README.distribution; Linux,
net/sched/sch_netem.c (tabledist).
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from hashlib import blake2b
from math import ceil, inf
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError, RejectedError
from cloudrc.link.carry.udp import Address
from cloudrc.link.draws import PARETO_CUT, Floats
from cloudrc.link.profile import Conditions, DirectionProfile, GilbertElliott, LinkSchedule, Loss

USE_RELAY = "use the relay (link.mode=relay, or --shaper relay)"
UNDO = "stop that program, and restart this pod"
ROOT, BAND, LEAF = "7400:", "7400:4", "7401:"  # root qdisc, band of the tunnel, its netem
PERIOD_NS = 1_000_000_000  # time between two checks of the qdiscs [ns]
STEP_NS = 5_000_000  # shortest time between two changes by a schedule; faster are skipped [ns]
LIMIT = 10_000  # largest number of packets in a qdisc without a bottleneck, as in the relay
DELAY_MAX_MS = 274_000  # longest delay that tc accepts [ms]: 2^32 ticks of 64 ns
ENTRIES = 4096  # number of entries in a table of a delay distribution
STRETCH = {"uniform": 1, "normal": 1, "pareto": 4}
"""Distribution -> divisor of the table's entries, so that the tail fits in 16 bits. To compensate,
tc gets the jitter multiplied by the same factor."""
_ONE = 8192
_END_OF_TABLE = 32_767 / _ONE  # largest 16-bit entry of a table, as a multiple of the jitter
_KEPT = 10_000  # number of recent changes from which the percentiles of the lateness are computed
_IN_ORDER = "100gbit"  # limits nothing; netem keeps packets in order if it has a rate
_ETHERNET_BYTES = 14  # Ethernet header, which netem counts and the model does not [bytes]
_PACKET_BITS = 8 * 116  # size of the smallest frequent datagram, a command with headers [bit]
_PACKETS = 1_000  # assumed packet rate without a bottleneck [1/s]; tunnel and probes send fewer
# The kernel's default for three bands: no type of service selects the fourth band.
_PRIO = "prio bands 4 priomap 1 2 2 2 1 2 0 0 1 1 1 1 1 1 1 1".split()


Run = Callable[[Sequence[str]], str]
"""Function that runs a program and returns its output; if that fails, it raises `explain`'s error.
"""


def explain(words: Sequence[str], text: str, *, missing: bool = False) -> CloudrcError:
    """Make an error with cause and remedy from the error output `text` of a program.

    `words` are the program and its arguments; `missing` means that the program is not installed.
    """
    text = " ".join(text.split())
    unknown = "kind is unknown", "classifier not found", "answers: No such file"
    cause, remedy = f"'{' '.join(words)}' failed: {text}", ""
    if missing:
        cause, remedy = f"no program {words[0]} (package iproute2)", "install it, or "
    elif "Operation not permitted" in text:
        cause = f"{words[0]} may not change the network of this container"
        remedy = "give it NET_ADMIN and uid 0, or "
    elif "add" in words and any(sign in text for sign in unknown):
        cause = "this kernel lacks sch_netem, sch_prio or cls_u32"
        remedy = (
            "use nodes whose kernel has them ('modprobe -a sch_netem sch_prio cls_u32' there) and "
            "a namespace for privileged pods, or "
        )
    fix = f"{remedy}{USE_RELAY}, which needs no kernel module"
    return MissingPrerequisiteError(cause, fix=fix)


def show(run: Run, *words: str) -> list[dict[str, Any]]:
    """Run `tc -s -j` with these arguments and return the objects that it prints."""
    return list(json.loads(run(("tc", "-s", "-j", *words)) or "[]"))


def find_device(run: Run, host: str) -> str:
    """Return the interface through which packets to a host leave."""
    return str(json.loads(run(("ip", "-j", "route", "get", host)))[0]["dev"])


def find_netems(run: Run, host: str) -> dict[str, Any]:
    """Find the interface to a host, and all netem qdiscs of this pod; {} if `ip` or `tc` fails.

    Returns:
        `interface`, and `netems`: interface -> its netem qdiscs, as `tc -s -j qdisc show` lists
        them; interfaces without a netem qdisc are left out.
    """
    netems = dict[str, list[dict[str, Any]]]()
    try:
        interface = find_device(run, host)
        for one in show(run, "qdisc", "show"):
            if one.get("kind") == "netem":
                netems.setdefault(str(one["dev"]), []).append(one)
    except (CloudrcError, ValueError, LookupError):
        return {}
    return {"interface": interface, "netems": netems}


_QUANTILES: dict[str, Callable[[Floats], Floats]] = {
    "uniform": lambda share: 2.0 * share - 1.0,
    "normal": np.vectorize(NormalDist().inv_cdf),
    "pareto": lambda share: (PARETO_CUT + (1.0 - PARETO_CUT) * (1.0 - share)) ** (-1 / 3),
}


def stretch(profile: DirectionProfile) -> int:
    """Return the divisor with which the entries of netem's table of delays fit in 16 bits.

    To compensate, tc gets the jitter multiplied by this divisor.
    """
    if profile.distribution != "table":
        return STRETCH[profile.distribution]
    return ceil(max(map(abs, profile.quantiles)) / _END_OF_TABLE) or 1


def table(profile: DirectionProfile) -> list[int]:
    """Compute netem's table for the distribution of a profile.

    Returns:
        Quantiles of the delay's random part at the probabilities (n + 0.5) / 4096, in rising
        order, shape (4096,). Their unit is jitter · s / 8192, where s = `stretch(profile)` keeps
        them within 16 bits.
    """
    if profile.distribution == "table":
        places = (2 * np.arange(ENTRIES) + 1) * len(profile.quantiles) // (2 * ENTRIES)
        values = np.sort(profile.quantiles)[places]
    else:
        values = _QUANTILES[profile.distribution]((np.arange(ENTRIES) + 0.5) / ENTRIES)
        if profile.distribution != "uniform":  # mean 0, standard deviation 1
            values = (values - values.mean()) / values.std()
    entries: list[int] = np.rint(values * _ONE / stretch(profile)).astype(int).tolist()
    return entries


def distribution_name(profile: DirectionProfile) -> str:
    """Return the name under which tc finds the table of a profile's distribution."""
    if profile.distribution != "table":
        return profile.distribution
    # tc makes a file name of it: only letters and digits, and another name for each table.
    return "table" + blake2b(repr(profile.quantiles).encode(), digest_size=8).hexdigest()


def write_table(folder: Path, profile: DirectionProfile) -> None:
    """Write the table of a profile's delays to `folder`; TC_LIB_DIR tells tc this folder."""
    name = distribution_name(profile)
    path = folder / f"{name}.dist"
    if not path.exists():  # the name determines the content
        path.write_text("\n".join([f"# {name}", *map(str, table(profile)), ""]))


def check(profile: DirectionProfile) -> None:
    """Raise a RejectedError with the reason if netem cannot realise a profile."""
    pieces = LinkSchedule(profile).pieces
    beyond = {
        "a schedule that repeats (loop, or start_s: random)": profile.loop,
        "rate_trace": bool(profile.opportunities),
        "radio (slots, requests and grants)": profile.radio is not None,
        "loss.delay_bad_ms (more delay while a burst of losses lasts)": any(
            isinstance(piece.loss, GilbertElliott) and piece.loss.delay_bad_ms for piece in pieces
        ),
        "rate_kbit with jitter_ms but without keep_order": not profile.keep_order
        and any(piece.rate and piece.jitter for piece in pieces),
        f"delay_ms above {DELAY_MAX_MS}": any(
            piece.delay_ns > DELAY_MAX_MS * 1e6 for piece in pieces
        ),
        f"blackouts shorter than {STEP_NS * 1e-6:g} ms": any(
            one.duration_s * 1e9 < STEP_NS for one in profile.blackouts
        ),
    }
    for what, holds in beyond.items():
        if holds:
            fix = f"{USE_RELAY}, which can, or leave it out"
            raise RejectedError(f"netem cannot do {what}", fix=fix)


def options(profile: DirectionProfile, conditions: Conditions, room: int) -> list[str]:
    """Convert the conditions at one instant to arguments of `tc qdisc add|change ... netem`.

    Call `check` for the profile first; `room` is the limit of the qdisc [packets].
    """
    words = ["limit", str(room), "delay", _microseconds(conditions.delay_ns)]
    if conditions.jitter:
        words += [_microseconds(conditions.jitter * 1e9 * stretch(profile))]
        words += [_percent(profile.correlation), "distribution", distribution_name(profile)]
    words += ["loss", *_loss(1.0 if conditions.blackout else conditions.loss)]
    # netem delivers one copy of a packet that is both duplicated and lost; a blackout must not.
    copied = 0.0 if conditions.blackout else profile.duplicate
    words += ["duplicate", _percent(copied), "corrupt", _percent(profile.corrupt)]
    # tc rejects it without a delay, as no packet can then be overtaken.
    if profile.reorder and conditions.delay_ns and not profile.keep_order:
        words += ["reorder", _percent(profile.reorder)]
    if conditions.rate is not None:
        return [*words, "rate", f"{conditions.rate:.0f}bit", str(-_ETHERNET_BYTES)]
    return [*words, "rate", _IN_ORDER if profile.keep_order else "0bit"]  # 0bit: no rate any more


def limit(profile: DirectionProfile) -> int:
    """Return the limit of the qdisc [packets]: packets under way plus the bottleneck's queue.

    The limit is constant along a schedule: when the delay becomes shorter, packets that are under
    way with the longer delay must not be dropped.
    """
    pieces = LinkSchedule(profile).pieces
    if all(piece.rate is None for piece in pieces):
        return LIMIT
    reach = stretch(profile) * _END_OF_TABLE
    under_way = [
        (piece.delay_ns * 1e-9 + piece.jitter * reach)
        * (piece.rate / _PACKET_BITS if piece.rate else _PACKETS)
        for piece in pieces
    ]
    return ceil(profile.queue_packets + max(under_way))


def _loss(loss: Loss) -> list[str]:
    if not isinstance(loss, GilbertElliott):
        return ["random", _percent(loss)]
    chances = (loss.bad_start, loss.bad_end, loss.loss_bad, loss.loss_good)
    return ["gemodel", *map(_percent, chances)]


def _microseconds(duration_ns: float) -> str:
    return f"{duration_ns * 1e-3:.3f}us"  # iproute2 before 6.2 knows no "ns"


def _percent(share: float) -> str:
    return f"{100.0 * share:.9g}%"


def leaf_of(qdiscs: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Return the qdisc that `Netem` made, out of an interface's qdiscs; None if it is missing."""
    found = (one for one in qdiscs if one.get("handle") == LEAF and one.get("kind") == "netem")
    return next(found, None) if _is_ours(_root_of(qdiscs)) else None


def _root_of(qdiscs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return next((one for one in qdiscs if one.get("root")), {"handle": "0:"})


def _is_ours(root: dict[str, Any]) -> bool:
    return root["handle"] == ROOT and root.get("kind") == "prio"


class Netem:
    """Shapes one direction of the link with the kernel's netem."""

    name = "netem"

    def __init__(
        self,
        run: Run,
        profile: DirectionProfile,
        origin_ns: int,
        *,
        clock: Callable[[], int],
        wait: Callable[[float], None],
        tables: Path,
        log: Callable[[str], None],
    ) -> None:
        """Store the arguments; the network does not change yet.

        `origin_ns` is the time on `clock` at which the link came up [ns]; `wait` sleeps for a time
        [s]; `tables` is the folder for the tables of distributions.
        """
        self._run = run
        self._clock, self._wait = clock, wait
        self._tables, self._log = tables, log
        self._device, self._damage, self._damages = "", "", 0
        self._looked_ns, self._stepped_ns = -PERIOD_NS, origin_ns
        self._applied: list[str] = []
        self._listed: object = None
        self._lateness_ns: deque[int] = deque(maxlen=_KEPT)
        self._take(profile, origin_ns)

    def _take(self, profile: DirectionProfile, origin_ns: int) -> None:
        self._profile, self._schedule = profile, LinkSchedule(profile)
        self._origin_ns, self._piece = origin_ns, -1
        self._room = self._least_room = limit(profile)
        if any(piece.jitter for piece in self._schedule.pieces):
            write_table(self._tables, profile)

    def follow_peer(self, peer: Address) -> Address:
        """Shape datagrams to this peer from now on, on the interface that leads to the peer.

        Returns:
            The route: the address to which this pod's end of the tunnel has to send.

        Raises:
            CloudrcError: If netem cannot realise the profile, or the kernel refuses.
        """
        device = find_device(self._run, peer[0])
        if device != self._device:
            self.close()
            self._device = device
        try:
            check(self._profile)
            if not self._applied:
                self._set_up()
            self._select(peer)
        except CloudrcError:
            self.close()
            raise
        return peer

    def follow_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Use this profile from now on; with `restart`, its schedule is at `start_ns` now.

        Without `restart`, the new schedule keeps the start time of the old one. Datagrams
        in flight are not lost. If netem cannot realise the profile, the method raises a
        CloudrcError and the old profile stays in force.
        """
        check(profile)
        held = self._look().get("held", 0)
        if self._damage:
            raise MissingPrerequisiteError(self._damage, fix=UNDO)
        before, room = (self._profile, self._origin_ns), self._room
        self._take(profile, self._clock() - start_ns if restart else self._origin_ns)
        if self._room < room:  # netem drops all packets while it holds more than its limit
            self._room += held
        try:
            self._apply("change")
        except CloudrcError:
            self._take(*before)
            self._step()
            raise

    def step(self, timeout: float) -> None:
        """Make the changes of the schedule that are due within the next `timeout` [s]."""
        until_ns = self._clock() + round(timeout * 1e9)
        if self._clock() - self._looked_ns >= PERIOD_NS:
            # Restore the limit when packets from before the change have left.
            if self._look().get("held", 0) < self._least_room:
                self._room = self._least_room
        while True:
            self._step()
            wake_ns = min(until_ns, self._next_ns())
            self._wait(max(0.0, wake_ns - self._clock()) * 1e-9)
            if wake_ns >= until_ns:
                return

    def counts(self) -> dict[str, int]:
        """Return counters of datagrams, percentiles of the lateness, and the counter `restored`.

        The datagrams are `forwarded` (including copies), `lost` (dropped at random or because the
        queue was full) and `held` (in the queue now); without the qdisc, these counters are absent.
        `step_lateness_p50_ns` and `step_lateness_p99_ns` are percentiles [ns] of how late the qdisc
        followed the changes of the schedule. `restored` is the number of times that another
        program removed or changed the qdiscs; despite the name, `Netem` does not restore them.
        """
        found = self._look() | {"restored": self._damages}
        if self._lateness_ns:
            late_ns = np.quantile(self._lateness_ns, (0.5, 0.99), method="inverted_cdf").tolist()
            found |= {"step_lateness_p50_ns": late_ns[0], "step_lateness_p99_ns": late_ns[1]}
        return found

    def released(self) -> dict[str, int]:
        """Return no statistics: the kernel does not report when datagrams leave the queue."""
        return {}

    def close(self) -> None:
        """Remove the qdiscs of `Netem`; queued datagrams are lost."""
        if self._device and _is_ours(_root_of(self._qdiscs())):
            self._run(("tc", "qdisc", "del", "dev", self._device, "root"))
        self._device, self._applied = "", []

    def _look(self) -> dict[str, int]:
        """Return the qdisc's packet counts; log and count other programs' changes of the qdisc."""
        self._looked_ns, leaf = self._clock(), leaf_of(self._qdiscs())
        found = leaf and leaf.get("options")
        self._listed = found if self._listed is None and found else self._listed
        said = ""
        if self._applied and (not found or found != self._listed):
            what = f"was changed to {json.dumps(found)}" if found else "was removed"
            said = (
                f"the qdisc of {self._device} {what} by another program, so the link no longer has "
                "the requested profile"
            )
        if said and said != self._damage:
            self._damages += 1
            self._log(f"error: {said}; {UNDO}")
        self._damage = said
        names = {"forwarded": "packets", "lost": "drops", "held": "qlen"}
        return {name: leaf[key] for name, key in names.items()} if leaf else {}

    def _set_up(self) -> None:
        """Add cloudrc's qdiscs, or take over those that an earlier process has left."""
        qdiscs, place = self._qdiscs(), ("dev", self._device, "root")
        root = _root_of(qdiscs)
        if root["handle"] != "0:" and not _is_ours(root):
            raise MissingPrerequisiteError(
                f"{self._device} has a qdisc already ({root['kind']} {root['handle']}) that is not "
                "cloudrc's",
                fix=f"remove it ('tc qdisc del {' '.join(place)}'), or {USE_RELAY}",
            )
        if not _is_ours(root):
            self._run(("tc", "qdisc", "add", *place, "handle", ROOT, *_PRIO))
        self._apply("add" if leaf_of(qdiscs) is None else "change")

    def _step(self) -> None:
        """Apply the present conditions; do not fail if another program has removed the qdisc."""
        try:
            self._apply("change")
        except CloudrcError:
            self._look()
            if not self._damage:
                raise

    def _apply(self, verb: str) -> None:
        """Run tc's `verb` ("add" or "change") if the conditions of the schedule have changed."""
        elapsed_ns, starts_ns = self._clock() - self._origin_ns, self._schedule.pass_ns
        before, self._piece = self._piece, max(bisect_right(starts_ns, elapsed_ns) - 1, 0)
        wanted = options(self._profile, self._schedule.pieces[self._piece], self._room)
        if wanted != self._applied:
            place = ("dev", self._device, "parent", BAND, "handle", LEAF)
            self._run(("tc", "qdisc", verb, *place, "netem", *wanted))
            self._applied, self._listed = wanted, None
        if 0 <= before < self._piece:  # the first piece of a schedule is no change
            self._stepped_ns = self._clock()
            due_ns = self._origin_ns + starts_ns[self._piece]
            self._lateness_ns.append(self._stepped_ns - due_ns)

    def _next_ns(self) -> float:
        """Return when the next change is due [ns]; infinite after the last change."""
        following = self._piece + 1
        if following >= len(self._schedule.pass_ns):
            return inf
        due_ns = self._origin_ns + self._schedule.pass_ns[following]
        return max(due_ns, self._stepped_ns + STEP_NS)

    def _select(self, peer: Address) -> None:
        """Direct the tunnel's datagrams to netem: add the new filter, then remove old filters."""
        listed = show(self._run, "filter", "show", "dev", self._device, "parent", ROOT)
        old = sorted({int(one["pref"]) for one in listed})
        new = next(number for number in range(1, len(old) + 2) if number not in old)
        host, port = peer
        match = f"ip protocol 17 0xff match ip dst {host}/32 match ip dport {port} 0xffff"
        place = ("dev", self._device, "parent", ROOT, "pref")
        words = ("protocol", "ip", "u32", "match", *match.split(), "flowid", BAND)
        self._run(("tc", "filter", "add", *place, str(new), *words))
        for number in old:
            self._run(("tc", "filter", "del", *place, str(number)))

    def _qdiscs(self) -> list[dict[str, Any]]:
        return show(self._run, "qdisc", "show", "dev", self._device)
