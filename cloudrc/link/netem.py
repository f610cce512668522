"""The kernel shapes the link: a profile goes in, `tc` puts it on the pod's egress.

    interface > prio 7400: --+-- bands 1-3: everything else, as before
                             +-- band 4 > netem 7401: what the filter sends there,
                                          UDP to the peer's tunnel port and nothing else

The set-up is found again after a restart by its handles, changed in flight by `tc qdisc change`,
which keeps what is queued, and removed by `close`. A root qdisc of somebody else is left alone.
What others do to ours is seen within a second (its filter within ten), put back, logged, counted.

Source: tc-prio(8), tc-netem(8), tc-u32(8), tc-flower(8).

What is in force, as the kernel tells it: tc's words and its listing go in, differences come out.

tc and the kernel clamp numbers without a word: a rate below 1 byte/s becomes none, a chance below
2**-32 becomes 0, a number of 32 bits wraps. What they made of ours is read back and compared.

Source: iproute2 tc/q_netem.c, netem_print_opt.

Whether netem is still as it was set up: listings of tc go in, what is wrong comes out.

Other hands reach a pod's interface, too: a person, a network plug-in, another tool. A link that is
not what was asked for and does not say so is worse than none.

How well a time line is followed: instants go in, counts and a line for people come out.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import Any

from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError
from cloudrc.link.profile import DirectionProfile, Timeline
from cloudrc.link.relay import Address
from cloudrc.link.tc import STEP_NS, Iproute2, Run, check, limit, options, write_measured

_TIME = re.compile(r"(?P<value>[\d.]+)us")
_RELATIVE = 1e-3
"""Rounding that nobody notices, as a share of the number."""
_TICK = 64e-9
"""Of tc's clock [s]."""
_CHANCE = 2.0**-30
"""A few steps of a chance of 32 bits, which is cut into percents with 9 digits."""

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


def differences(words: Sequence[str], listed: Mapping[str, Any]) -> list[str]:
    """Compare what tc was asked for with what it says is in force.

    Args:
        words: As `tc.options` gives them.
        listed: "options" of the qdisc, as `tc -j qdisc show` prints them.

    Returns:
        One text per number that is not what was asked: "rate: asked 0.5, in force 0".
    """
    found = []
    for option, keys, asked in _asked(words):
        inside = listed if not keys[0] else listed.get(keys[0], {})
        for key, value in zip(keys[1], asked, strict=False):
            shown = float(inside.get(key, 0.0))
            near = abs(shown - value) <= max(_slack(option), _RELATIVE * abs(value))
            if not near or (value and not shown):
                name = key if len(keys[1]) == 1 else f"{option} {key}"
                found.append(f"{name}: asked {value:g}, in force {shown:g}")
    return found


def _asked(words: Sequence[str]) -> Iterator[tuple[str, tuple[str, tuple[str, ...]], list[float]]]:
    """Take tc's words apart: each option with where it is listed and its numbers in SI."""
    option, numbers = "", list[float]()
    for word in [*words, "end"]:
        if word in _LISTED or word in ("loss", "distribution", "end"):
            if option:
                yield option, _LISTED[option], numbers
            option, numbers = word if word in _LISTED else "", []
        elif option:
            numbers.append(_number(word))


def _number(word: str) -> float:
    """Read a number of tc's: times in [s], chances in [0, 1], rates in [byte/s], others as is."""
    if match := _TIME.fullmatch(word):
        return float(match["value"]) * 1e-6
    if word.endswith("%"):
        return float(word[:-1]) * 1e-2
    for unit, scale in (("gbit", 1.25e8), ("bit", 0.125)):
        if word.endswith(unit):
            return float(word.removesuffix(unit)) * scale
    return float(word)


def _slack(option: str) -> float:
    if option in ("limit", "rate"):
        return 0.0
    return 2 * _TICK if option == "delay" else _CHANCE


ROOT, BAND, LEAF = "7400:", "7400:4", "7401:"
"""Handles of the classful root, of its band for the tunnel's flow, and of the netem there."""
PERIOD_NS = 1_000_000_000
"""Between two looks at the qdiscs [ns]."""
FILTER_LOOKS = 10
"""Every so many looks the filter is looked at, too, which takes a process of its own."""


def is_ours(qdiscs: Sequence[dict[str, Any]]) -> bool:
    """Say whether the root of an interface is what `Netem` puts there."""
    return any(
        one.get("root") and one.get("handle") == ROOT and one.get("kind") == "prio"
        for one in qdiscs
    )


def counters(qdiscs: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Read what netem has counted from the objects of `tc -s -j qdisc show`.

    Returns:
        `forwarded`: sent on, copies included; `lost`: dropped, whether by chance or because the
        queue was full; `held`: queued now. Empty if there is no such qdisc.
    """
    for one in qdiscs:
        if one.get("handle") == LEAF and one.get("kind") == "netem":
            return {"forwarded": one["packets"], "lost": one["drops"], "held": one["qlen"]}
    return {}


def damage(qdiscs: Sequence[dict[str, Any]], applied: Sequence[str]) -> str:
    """Say in words what somebody has done to the qdiscs.

    Args:
        qdiscs: Of the interface.
        applied: Words that netem was given last.

    Returns:
        "" if nothing.
    """
    leaf = next((one for one in qdiscs if one.get("handle") == LEAF), None)
    if not is_ours(qdiscs) or leaf is None or leaf.get("kind") != "netem":
        return "was removed"
    found = differences(applied, leaf.get("options", {}))
    return f"was changed ({'; '.join(found)})" if found else ""


class Kept:
    """What has been put back, and what the qdiscs before had counted.

    Attributes:
        restored: How often something was put back.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self.restored = 0
        self._log, self._said = log, ""
        self._looked_ns, self._looks = -PERIOD_NS, 0
        self._now: dict[str, int] = {}
        self._before: dict[str, int] = {}

    def due(self, now_ns: int) -> bool:
        """Say whether it is time for a look [ns]."""
        return now_ns - self._looked_ns >= PERIOD_NS

    def looks(self, now_ns: int) -> bool:
        """Note that it is looked now [ns]; True if the filter's turn has come, too."""
        self._looked_ns = now_ns
        self._looks += 1
        return self._looks % FILTER_LOOKS == 0

    def counted(self, counts: dict[str, int]) -> dict[str, int]:
        """Add what qdiscs before have counted; a new one begins at 0."""
        if not counts or counts["forwarded"] < self._now.get("forwarded", 0):
            for name in ("forwarded", "lost"):
                self._before[name] = self._before.get(name, 0) + self._now.get(name, 0)
        self._now = counts
        totals = counts or dict.fromkeys(self._before, 0)
        return {name: n + self._before.get(name, 0) for name, n in totals.items()}

    def put_back(self, what: str) -> None:
        """Note that it was put back after somebody has done `what`; log it."""
        self.restored += 1
        self._said = ""
        self._log(f"{what} by another hand, and put back ({self.restored} times so far)")

    def cannot(self, what: str, why: str) -> None:
        """Note that it cannot be put back; log it unless that was the last thing that was said."""
        line = f"{what} by another hand, and cannot be put back: {why}"
        if line != self._said:
            self._said = line
            self._log(line)


LATE_NS = 20_000_000
"""A step that is later than this is counted as late [ns]: two periods of the loop."""
_KEPT = 10_000


class Steps:
    """Counts the steps of a qdisc.

    Attributes:
        applied: Steps that were put into force.
        late: Those of them that were later than `LATE_NS`.
        passed_over: Steps of the time line that were over before their turn came.
    """

    def __init__(self) -> None:
        self.applied = self.late = self.passed_over = 0
        self._lateness_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, lateness_ns: int, passed_over: int) -> None:
        """Note a step.

        Args:
            lateness_ns: From when it was due until tc said that it is in force [ns].
            passed_over: Steps between the one before and this one.
        """
        self.applied += 1
        self.late += lateness_ns > LATE_NS
        self.passed_over += passed_over
        self._lateness_ns.append(lateness_ns)

    def lateness_ns(self) -> tuple[int, int]:
        """Give median and 99th percentile of the last 10,000 latenesses [ns]; 0 without any."""
        ordered = sorted(self._lateness_ns) or [0]
        return ordered[(len(ordered) - 1) // 2], ordered[ceil(0.99 * (len(ordered) - 1))]

    def counts(self) -> dict[str, int]:
        """Say how many steps there were and how late they were; empty before the first."""
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
        """Say how it went."""
        median, worst = (late_ns * 1e-6 for late_ns in self.lateness_ns())
        over = f", {self.passed_over} passed over" if self.passed_over else ""
        return (
            f"{self.applied} steps of the time line, late by {median:.2f} ms in the median and "
            f"{worst:.2f} ms at the 99th percentile, {self.late} above {LATE_NS * 1e-6:g} ms{over}"
        )


def pause_ns(due_ns: int, stepped_ns: int) -> int:
    """Say when the step due at `due_ns` may be taken after one at `stepped_ns` [ns]."""
    return max(due_ns, stepped_ns + STEP_NS)


# The kernel's own default for three bands: nothing falls into the fourth by its type of service.
_PRIO = "prio bands 4 priomap 1 2 2 2 1 2 0 0 1 1 1 1 1 1 1 1".split()
_UDP = "17"


class Netem:
    """One direction of the link in the kernel; a `Shaper`.

    Attributes:
        steps: How well the time line has been followed so far.
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
        """Set up, without touching the network yet.

        Args:
            run: Runs tc and ip; its environment's TC_LIB_DIR names the folder that
                `netem_tables.write_tables` filled.
            profile: Conditions.
            origin_ns: When the link came up [ns]; the time line counts from it.
            clock: Tells the time on the clock of `origin_ns` [ns].
            wait: Sleeps for so long [s].
            tables: That folder, where a profile's measured distribution is added.
            log: Gets lines for people.
        """
        self._iproute2 = Iproute2(run)
        self._clock, self._wait = clock, wait
        self._tables, self._log = tables, log
        self._device = ""
        self._peer: Address | None = None
        self._kept = Kept(log)
        self._applied: list[str] = []
        self._stepped_ns = origin_ns
        self.steps = Steps()
        self._follow(profile, origin_ns)

    def _follow(self, profile: DirectionProfile, origin_ns: int) -> None:
        self._profile, self._timeline = profile, Timeline(profile)
        self._origin_ns, self._piece, self._piece_room = origin_ns, -1, 0
        self._room = self._least_room = limit(profile)
        if self._tables is not None:
            write_measured(self._tables, profile)

    def follow_peer(self, peer: Address) -> Address:
        """Shape what goes to this peer from now on, on the interface that leads to it."""
        device = self._iproute2.device(peer[0])
        if device != self._device:
            self.close()
            self._device = device
        self._peer = peer
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
        """Shape by this profile from now on; what is queued leaves when it would have.

        Args:
            profile: Conditions.
            restart: Whether their time line counts from now; else from when the old one did.
        """
        check(profile)
        qdiscs = self._qdiscs() if self._applied else []
        self._look(qdiscs)  # what another hand has done is no reason to refuse
        before, room = (self._profile, self._origin_ns), self._room
        self._follow(profile, self._clock() if restart else self._origin_ns)
        if self._room < room:  # netem takes nothing in while it holds more than its limit
            self._room += counters(qdiscs).get("held", 0)
        try:
            self._apply("change")
            self._confirm()
        except CloudrcError:
            self._follow(*before)
            self._follow_time_line()
            raise

    def step(self, timeout: float) -> None:
        """Put into force what the time line says, as it says it, for `timeout` [s]."""
        until_ns = self._clock() + round(timeout * 1e9)
        if self._kept.due(self._clock()):
            self._look(qdiscs := self._qdiscs())
            self._take_back_room(qdiscs)
        while True:
            self._follow_time_line()
            due_ns = self._next_ns()
            wake_ns = until_ns if due_ns is None else min(due_ns, until_ns)
            self._wait(max(0, wake_ns - self._clock()) * 1e-9)
            if wake_ns >= until_ns:
                return

    def counts(self) -> dict[str, int]:
        """Say how many datagrams netem sent on, dropped (losses included) and holds.

        Beside them the steps of the time line, and `restored`: how often another hand had removed
        or changed what is set up here, and it was put back.
        """
        qdiscs = self._qdiscs()
        counts = self._kept.counted(counters(qdiscs))
        self._look(qdiscs)
        return counts | self.steps.counts() | {"restored": self._kept.restored}

    def released(self) -> dict[str, int]:
        """Give nothing: the kernel does not tell when what was queued has left."""
        return {}

    def close(self) -> None:
        """Remove the qdiscs, if they are ours; what is queued in them is lost."""
        if self._device and is_ours(self._qdiscs()):
            self._iproute2.tc("qdisc", "del", "dev", self._device, "root")
        self._device, self._applied = "", []

    def _look(self, qdiscs: list[dict[str, Any]]) -> None:
        """Put back what is not as it was set up."""
        filters = self._kept.looks(self._clock())
        if not self._applied or self._peer is None:
            return
        what = damage(qdiscs, self._applied)
        lost = "removed" in what or (filters and not what and not self._filters_there())
        if not what and not lost:
            return
        what = f"the qdisc of {self._device} {what or 'lost its filter'}"
        before, self._applied = self._applied, []
        try:
            self._kept.counted(counters(qdiscs))
            self._set_up()
            self._confirm()
            if lost:
                self._select(self._peer)
        except CloudrcError as error:
            self._applied = before
            self._kept.cannot(what, str(error))
        else:
            self._kept.put_back(what)

    def _set_up(self) -> None:
        """Put the qdiscs in place, those included that an earlier process left."""
        qdiscs, device = self._qdiscs(), self._device
        root = next((one for one in qdiscs if one.get("root")), {"handle": "0:"})
        if root["handle"] != "0:" and not is_ours(qdiscs):
            raise MissingPrerequisiteError(
                f"{device} has a qdisc already ({root['kind']} {root['handle']}) that is not "
                f"cloudrc's; remove it ('tc qdisc del dev {device} root'), or set link.mode=relay"
            )
        if not is_ours(qdiscs):
            self._add_root()
        there = any(one.get("handle") == LEAF for one in qdiscs)
        self._apply("change" if there else "add")

    def _add_root(self) -> None:
        place = ("dev", self._device, "root")
        try:
            self._iproute2.tc("qdisc", "add", *place, "handle", ROOT, *_PRIO)
        except MissingPrerequisiteError:
            # A kernel without sch_prio mostly lacks sch_netem, too, which is what people look for.
            self._iproute2.tc("qdisc", "add", *place, "netem")
            self._iproute2.tc("qdisc", "del", *place)
            raise

    def _follow_time_line(self) -> None:
        try:
            self._apply("change")
        except CloudrcError:
            before = self._kept.restored
            self._look(self._qdiscs())
            if self._kept.restored == before:
                raise

    def _take_back_room(self, qdiscs: list[dict[str, Any]]) -> None:
        """Let the limit be as asked, once what was under way at a change in flight has left."""
        if self._least_room < self._room and counters(qdiscs).get("held", 0) < self._least_room:
            self._room = self._least_room  # the next step puts it in force

    def _apply(self, verb: str) -> None:
        """Let what holds now be in force, unless it is."""
        elapsed_ns = self._clock() - self._origin_ns
        starts_ns = self._timeline.starts_ns
        piece = max(bisect_right(starts_ns, elapsed_ns) - 1, 0)
        if (piece, self._room) == (self._piece, self._piece_room) and self._applied:
            return
        wanted = options(self._profile, self._timeline.at(elapsed_ns), self._room)
        if wanted != self._applied:
            place = ("dev", self._device, "parent", BAND, "handle", LEAF)
            self._iproute2.tc("qdisc", verb, *place, "netem", *wanted)
            self._applied = wanted
        # The first piece was not stepped to, and neither was one that is as the one before.
        if 0 <= self._piece < piece:
            done_ns, due_ns = self._clock(), self._origin_ns + starts_ns[piece]
            self._stepped_ns = done_ns
            self.steps.note(done_ns - due_ns, piece - self._piece - 1)
            if piece == len(starts_ns) - 1:
                self._log(self.steps.in_words())
        self._piece, self._piece_room = piece, self._room

    def _next_ns(self) -> int | None:
        """Say when to look at the time line again [ns]; None if nothing more will happen."""
        following = self._piece + 1
        if following >= len(self._timeline.starts_ns):
            return None
        return pause_ns(self._origin_ns + self._timeline.starts_ns[following], self._stepped_ns)

    def _confirm(self) -> None:
        """Read back what is in force, and refuse what is not as it was asked for."""
        listed = next((one for one in self._qdiscs() if one.get("handle") == LEAF), None)
        if listed is None:
            raise MissingPrerequisiteError(
                f"the qdisc of {self._device} was removed by another hand meanwhile; find out whose"
            )
        found = differences(self._applied, listed.get("options", {}))
        if found:
            raise BadInputError(
                f"netem cannot do what is asked ({'; '.join(found)}); set link.mode=relay, which "
                "can, or ask for other values"
            )

    def _select(self, peer: Address) -> None:
        """Send the tunnel's flow to netem: first a new filter, then without the old ones."""
        old = self._filters_there()
        new = next(number for number in range(1, len(old) + 2) if number not in old)
        try:
            self._add_filter(new, _u32(peer))
        except MissingPrerequisiteError:
            self._add_filter(new, _flower(peer))
        for number in old:
            self._iproute2.tc("filter", "del", *self._filters(number))

    def _filters_there(self) -> list[int]:
        show = self._iproute2.show("filter", "show", "dev", self._device, "parent", ROOT)
        return sorted({int(one["pref"]) for one in show})

    def _add_filter(self, number: int, match: Sequence[str]) -> None:
        self._iproute2.tc("filter", "add", *self._filters(number), "protocol", "ip", *match)

    def _filters(self, number: int) -> tuple[str, ...]:
        return ("dev", self._device, "parent", ROOT, "pref", str(number))

    def _qdiscs(self) -> list[dict[str, Any]]:
        return self._iproute2.show("qdisc", "show", "dev", self._device)


def _u32(peer: Address) -> list[str]:
    host, port = peer
    protocol = ["match", "ip", "protocol", _UDP, "0xff"]
    address = ["match", "ip", "dst", f"{host}/32", "match", "ip", "dport", str(port), "0xffff"]
    return ["u32", *protocol, *address, "flowid", BAND]


def _flower(peer: Address) -> list[str]:
    host, port = peer
    address = ["dst_ip", host, "dst_port", str(port)]
    return ["flower", "ip_proto", "udp", *address, "classid", BAND]
