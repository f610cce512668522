"""Shape one direction of the link in the kernel, by `tc` on the pod's egress.

    interface > prio 7400: --+-- bands 1-3: everything else, as before
                             +-- band 4 > netem 7401: datagrams that the filter selects:
                                          only UDP to the peer's tunnel port

After a restart `Netem` finds its qdiscs by their handles. In flight it changes the qdiscs by `tc
qdisc change`, which keeps the queued packets. `close` removes the qdiscs. `Netem` never touches a
root qdisc of another program. If another program removes or changes the qdiscs of `Netem`, the log
says so and a metric counts the case; `Netem` does not repair the damage.

tc and the kernel clamp numbers without a message: a rate below 1 byte/s turns into no rate limit, a
probability below 2**-32 turns into 0. So `Netem` reads back the options in force and compares them.

Source: tc-prio(8), tc-netem(8), tc-u32(8), tc-flower(8); iproute2 tc/q_netem.c, netem_print_opt.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import Any

from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError
from cloudrc.link.profile import DirectionProfile, Timeline
from cloudrc.link.relay import Address
from cloudrc.link.tc import STEP_NS, Iproute2, Run, check, limit, options, write_measured

ROOT, BAND, LEAF = "7400:", "7400:4", "7401:"
"""Handles of the root qdisc, of its band for the tunnel's flow, and of the netem there."""
PERIOD_NS = 1_000_000_000
"""Time between two checks of the qdiscs [ns]."""
LATE_NS = 20_000_000
"""A step counts as late if its lateness is above this [ns]: two periods of the loop."""
_KEPT = 10_000
"""Number of latest steps that the percentiles cover [1]."""
# The kernel's own default for three bands: nothing falls into the fourth by its type of service.
_PRIO = "prio bands 4 priomap 1 2 2 2 1 2 0 0 1 1 1 1 1 1 1 1".split()

# Option of tc -> the object and the keys in its listing; what is not listed is 0.
_LISTED = {
    "limit": ("", ("limit",)),
    "delay": ("delay", ("delay", "jitter", "correlation")),
    "random": ("loss-random", ("loss",)),
    "gemodel": ("loss-gemodel", ("p", "r", "1-h", "1-k")),
    "duplicate": ("duplicate", ("duplicate",)),
    "corrupt": ("corrupt", ("corrupt",)),
    "reorder": ("reorder", ("reorder",)),
    "rate": ("rate", ("rate",)),
}
_UNITS = {"us": 1e-6, "%": 1e-2, "gbit": 1.25e8, "bit": 0.125, "": 1.0}
"""Unit in tc's arguments -> factor to the unit in tc's listing: [s], [1], [byte/s]."""
_SLACK = {"limit": 0.0, "rate": 0.0, "delay": 128e-9}
"""Option -> tolerance for tc's rounding: 128 ns for delays [s]. Options that are not listed are
probabilities, which tc cuts to 32 bits."""
_CHANCE = 2.0**-30
_RELATIVE = 1e-3
"""Relative tolerance for rounding [1]."""


def differences(words: Sequence[str], listed: Mapping[str, Any]) -> list[str]:
    """Compare the requested options with those in force.

    Args:
        words: The requested options, from `tc.options`.
        listed: "options" of the qdisc, as `tc -j qdisc show` prints them.

    Returns:
        One text per number that differs, such as "rate: asked 0.5, in force 0".
    """
    found, option, index = list[str](), "", 0
    for word in words:
        number = re.fullmatch(r"(-?[\d.e-]+)(us|%|gbit|bit|)", word)
        if number is None:  # a keyword, or the name of a distribution
            option, index = word, 0
            continue
        place, keys = _LISTED.get(option, ("", ()))
        if index < len(keys):
            asked, key = float(number[1]) * _UNITS[number[2]], keys[index]
            shown = float((listed.get(place, {}) if place else listed).get(key, 0.0))
            slack = max(_SLACK.get(option, _CHANCE), _RELATIVE * abs(asked))
            if abs(shown - asked) > slack or (asked and not shown):
                name = key if len(keys) == 1 else f"{option} {key}"
                found.append(f"{name}: asked {asked:g}, in force {shown:g}")
        index += 1
    return found


def is_ours(qdiscs: Sequence[dict[str, Any]]) -> bool:
    """Return whether the root qdisc of an interface is from `Netem`."""
    return any(
        one.get("root") and one.get("handle") == ROOT and one.get("kind") == "prio"
        for one in qdiscs
    )


def leaf_of(qdiscs: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """Find the netem qdisc of `Netem` among the qdiscs of an interface; None if it is missing."""
    found = (one for one in qdiscs if one.get("handle") == LEAF and one.get("kind") == "netem")
    return next(found, None) if is_ours(qdiscs) else None


def counters(qdiscs: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Read netem's counts from the objects of `tc -s -j qdisc show`.

    Returns:
        `forwarded`: datagrams sent on, copies included; `lost`: datagrams dropped at random or
        because the queue was full; `held`: datagrams queued now. Empty without a netem qdisc.
    """
    leaf = leaf_of(qdiscs)
    if leaf is None:
        return {}
    return {"forwarded": leaf["packets"], "lost": leaf["drops"], "held": leaf["qlen"]}


def damage(qdiscs: Sequence[dict[str, Any]], applied: Sequence[str]) -> str:
    """Describe how another program has changed the qdiscs.

    Args:
        qdiscs: Qdiscs of the interface.
        applied: Options that netem got last.

    Returns:
        The damage in words; "" without damage.
    """
    leaf = leaf_of(qdiscs)
    if leaf is None:
        return "was removed"
    found = differences(applied, leaf.get("options", {}))
    return f"was changed ({'; '.join(found)})" if found else ""


class Steps:
    """Counts the steps of a qdisc along a time line.

    Attributes:
        applied: Number of steps that took effect.
        late: Number of these steps with a lateness above `LATE_NS`.
        passed_over: Number of skipped steps: the next step was due before they could take effect.
    """

    def __init__(self) -> None:
        self.applied = self.late = self.passed_over = 0
        self._lateness_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, lateness_ns: int, passed_over: int) -> None:
        """Count a step.

        Args:
            lateness_ns: Time from when the step was due until tc reported that it is in force [ns].
            passed_over: Number of steps that were skipped just before this step.
        """
        self.applied += 1
        self.late += lateness_ns > LATE_NS
        self.passed_over += passed_over
        self._lateness_ns.append(lateness_ns)

    def lateness_ns(self) -> tuple[int, int]:
        """Return median and 99th percentile of the lateness of the last 10,000 steps [ns].

        Both are 0 before the first step.
        """
        ordered = sorted(self._lateness_ns) or [0]
        return ordered[(len(ordered) - 1) // 2], ordered[ceil(0.99 * (len(ordered) - 1))]

    def counts(self) -> dict[str, int]:
        """Return the number of steps and their lateness; empty before the first."""
        if not self.applied:
            return {}
        median_ns, worst_ns = self.lateness_ns()
        return {
            "steps": self.applied,
            "steps_late": self.late,
            "steps_passed_over": self.passed_over,
            "step_lateness_p50_ns": median_ns,
            "step_lateness_p99_ns": worst_ns,
        }

    def in_words(self) -> str:
        """Describe the steps so far."""
        median, worst = (late_ns * 1e-6 for late_ns in self.lateness_ns())
        over = f", {self.passed_over} passed over" if self.passed_over else ""
        return (
            f"{self.applied} steps of the time line, late by {median:.2f} ms in the median and "
            f"{worst:.2f} ms at the 99th percentile, {self.late} above {LATE_NS * 1e-6:g} ms{over}"
        )


class Netem:
    """One direction of the link in the kernel; a `Shaper`.

    Attributes:
        steps: Counts and lateness of the steps along the time line so far.
    """

    name = "netem"

    def __init__(
        self,
        run: Run,
        profile: DirectionProfile,
        *,
        origin_ns: int,
        clock: Callable[[], int],
        wait: Callable[[float], None],
        tables: Path | None = None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Set up; do not touch the network yet.

        Args:
            run: Runs tc and ip.
            profile: Conditions.
            origin_ns: When the link came up [ns]; the time line starts at this instant.
            clock: Returns the time on the clock of `origin_ns` [ns].
            wait: Sleeps for a time [s].
            tables: Folder of tc's tables, for a profile's measured distribution.
            log: Receives lines for people.
        """
        self._iproute2 = Iproute2(run)
        self._clock, self._wait = clock, wait
        self._tables, self._log = tables, log
        self._device, self._damage, self._damages = "", "", 0
        self._looked_ns, self._stepped_ns = -PERIOD_NS, origin_ns
        self._applied: list[str] = []
        self.steps = Steps()
        self._take(profile, origin_ns)

    def _take(self, profile: DirectionProfile, origin_ns: int) -> None:
        self._profile, self._timeline = profile, Timeline(profile)
        self._origin_ns, self._piece = origin_ns, -1
        self._room = self._least_room = limit(profile)
        if self._tables is not None:
            write_measured(self._tables, profile)

    def follow_peer(self, peer: Address) -> Address:
        """Shape datagrams to this peer from now on, on the interface that leads to the peer."""
        device = self._iproute2.device(peer[0])
        if device != self._device:
            self.close()
            self._device = device
        try:
            check(self._profile)
            if not self._applied:
                self._set_up()
                self._confirm()
            self._select(peer)
        except CloudrcError:
            self.close()
            raise
        return peer

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; queued datagrams keep their delay.

        Args:
            profile: Conditions.
            restart: True: the time line starts now. False: the time line continues.
        """
        check(profile)
        qdiscs = self._look()
        if self._damage:
            raise MissingPrerequisiteError(self._damage)
        before, room = (self._profile, self._origin_ns), self._room
        self._take(profile, self._clock() if restart else self._origin_ns)
        if self._room < room:  # netem takes nothing in while it holds more than its limit
            self._room += counters(qdiscs).get("held", 0)
        try:
            self._apply("change")
            self._confirm()
        except CloudrcError:
            self._take(*before)
            self._step()
            raise

    def step(self, timeout: float) -> None:
        """Apply the steps of the time line when they are due, for `timeout` [s]."""
        until_ns = self._clock() + round(timeout * 1e9)
        if self._clock() - self._looked_ns >= PERIOD_NS:
            # The limit is as asked again once what was under way at a change has left.
            if counters(self._look()).get("held", 0) < self._least_room:
                self._room = self._least_room
        while True:
            self._step()
            due_ns = self._next_ns()
            wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
            self._wait(max(0, wake_ns - self._clock()) * 1e-9)
            if wake_ns >= until_ns:
                return

    def counts(self) -> dict[str, int]:
        """Return `counters`, the counts of `steps`, and `restored`.

        `restored` is how often another program has removed or changed the qdiscs. Its name comes
        from an older metric; nothing is restored.
        """
        return counters(self._look()) | self.steps.counts() | {"restored": self._damages}

    def released(self) -> dict[str, int]:
        """Return an empty dict: the kernel does not tell when queued datagrams have left."""
        return {}

    def close(self) -> None:
        """Remove the qdiscs if they are from `Netem`; queued datagrams are lost."""
        if self._device and is_ours(self._qdiscs()):
            self._iproute2.tc("qdisc", "del", "dev", self._device, "root")
        self._device, self._applied = "", []

    def _look(self) -> list[dict[str, Any]]:
        """Read the qdiscs; log and count damage by another program."""
        self._looked_ns, qdiscs = self._clock(), self._qdiscs()
        what = damage(qdiscs, self._applied) if self._applied else ""
        said = (
            f"the qdisc of {self._device} {what} by another program, so the link is not as asked; "
            "find out which, and restart this pod to set it up again"
        )
        if what and said != self._damage:
            self._damages += 1
            self._log(f"error: {said}")
        self._damage = said if what else ""
        return qdiscs

    def _set_up(self) -> None:
        """Add the qdiscs, or take over the qdiscs of an earlier process."""
        qdiscs, device = self._qdiscs(), self._device
        root = next((one for one in qdiscs if one.get("root")), {"handle": "0:"})
        if root["handle"] != "0:" and not is_ours(qdiscs):
            raise MissingPrerequisiteError(
                f"{device} has a qdisc already ({root['kind']} {root['handle']}) that is not "
                f"cloudrc's; remove it ('tc qdisc del dev {device} root'), or set link.mode=relay"
            )
        if not is_ours(qdiscs):
            self._add_root()
        self._apply("add" if leaf_of(qdiscs) is None else "change")

    def _add_root(self) -> None:
        place = ("dev", self._device, "root")
        try:
            self._iproute2.tc("qdisc", "add", *place, "handle", ROOT, *_PRIO)
        except MissingPrerequisiteError:
            # A kernel without sch_prio mostly lacks sch_netem, too, which is what people look for.
            self._iproute2.tc("qdisc", "add", *place, "netem")
            self._iproute2.tc("qdisc", "del", *place)
            raise

    def _step(self) -> None:
        """Apply the present step of the time line; tolerate damage by another program."""
        try:
            self._apply("change")
        except CloudrcError:
            self._look()
            if not self._damage:
                raise

    def _apply(self, verb: str) -> None:
        """Bring the present conditions into force, unless they already are."""
        elapsed_ns, starts_ns = self._clock() - self._origin_ns, self._timeline.pass_ns
        before, self._piece = self._piece, max(bisect_right(starts_ns, elapsed_ns) - 1, 0)
        wanted = options(self._profile, self._timeline.at(elapsed_ns), self._room)
        if wanted != self._applied:
            place = ("dev", self._device, "parent", BAND, "handle", LEAF)
            self._iproute2.tc("qdisc", verb, *place, "netem", *wanted)
            self._applied = wanted
        if 0 <= before < self._piece:  # the first piece of a time line is no step
            self._stepped_ns = self._clock()
            due_ns = self._origin_ns + starts_ns[self._piece]
            self.steps.note(self._stepped_ns - due_ns, self._piece - before - 1)
            if self._piece == len(starts_ns) - 1:
                self._log(self.steps.in_words())

    def _next_ns(self) -> int | None:
        """Return when the next step may take effect [ns]; None after the last step."""
        following = self._piece + 1
        if following >= len(self._timeline.pass_ns):
            return None
        due_ns = self._origin_ns + self._timeline.pass_ns[following]
        return max(due_ns, self._stepped_ns + STEP_NS)

    def _confirm(self) -> None:
        """Read back the options in force; raise an error if they differ from the requested ones."""
        leaf = leaf_of(self._qdiscs())
        if leaf is None:
            raise MissingPrerequisiteError(
                f"the qdisc of {self._device} was removed by another program meanwhile; find out "
                "which"
            )
        found = differences(self._applied, leaf.get("options", {}))
        if found:
            raise BadInputError(
                f"netem cannot do what is asked ({'; '.join(found)}); set link.mode=relay, which "
                "can, or ask for other values"
            )

    def _select(self, peer: Address) -> None:
        """Direct the tunnel's flow to netem: add the new filter, then remove the old filters."""
        listed = self._iproute2.show("filter", "show", "dev", self._device, "parent", ROOT)
        old = sorted({int(one["pref"]) for one in listed})
        new = next(number for number in range(1, len(old) + 2) if number not in old)
        host, port = peer
        u32 = f"u32 match ip protocol 17 0xff match ip dst {host}/32 match ip dport {port} 0xffff"
        flower = f"flower ip_proto udp dst_ip {host} dst_port {port}"
        try:
            self._filter("add", new, "protocol", "ip", *u32.split(), "flowid", BAND)
        except MissingPrerequisiteError:
            self._filter("add", new, "protocol", "ip", *flower.split(), "classid", BAND)
        for number in old:
            self._filter("del", number)

    def _filter(self, verb: str, number: int, *match: str) -> None:
        place = ("dev", self._device, "parent", ROOT, "pref", str(number))
        self._iproute2.tc("filter", verb, *place, *match)

    def _qdiscs(self) -> list[dict[str, Any]]:
        return self._iproute2.show("qdisc", "show", "dev", self._device)
