"""Call iproute2; translate a profile into options and jitter tables of tc-netem.

Every call gives all options of netem, because `tc qdisc change` does not reset a rate or a
correlation that it does not name.

netem draws jitter from a table of at most 16,384 integers of 16 bits; the entry 8192 means one
times the jitter. The tables that come with tc differ from the model's distributions, and tc has no
table for the uniform distribution.

Source: tc-netem(8); iproute2 netem/README.distribution; Linux, net/sched/sch_netem.c (tabledist).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from hashlib import blake2b
from itertools import pairwise
from math import ceil, sqrt
from pathlib import Path
from statistics import NormalDist, fmean
from typing import Any, NamedTuple, TypeAlias

from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError
from cloudrc.link.draws import PARETO_CUT
from cloudrc.link.profile import Conditions, DirectionProfile, GilbertElliott, Loss, Timeline

NOT_FOUND = 127
"""Exit code when the program does not exist."""
_TRIAL = "7402:"
_INSTEAD = "set link.mode=relay, which needs nothing of the kernel"


class Answer(NamedTuple):
    """Exit code, standard output and standard error of a program."""

    code: int
    output: str
    error: str


Run: TypeAlias = Callable[[Sequence[str]], Answer]
"""Function that runs a program to its end."""


class Iproute2:
    """Runs `tc` and `ip`; checks the result of each call."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def tc(self, *words: str) -> str:
        """Run tc and return its output; if it fails, raise the error that `explain` makes."""
        return self._checked("tc", words)

    def show(self, *words: str) -> list[dict[str, Any]]:
        """Run `tc -s -j` with these words and return the objects that it prints."""
        return list(json.loads(self._checked("tc", ("-s", "-j", *words)) or "[]"))

    def device(self, host: str) -> str:
        """Return the interface that leads to an address."""
        routes = json.loads(self._checked("ip", ("-j", "route", "get", host)))
        return str(routes[0]["dev"])

    def _checked(self, program: str, words: Sequence[str]) -> str:
        answer = self._run((program, *words))
        if answer.code:
            raise explain(program, words, answer)
        return answer.output


def try_netem(run: Run) -> None:
    """Check whether this kernel has netem: add a netem without delay to the loopback interface.

    If the loopback already has a qdisc of another program, nothing is changed or checked.

    Raises:
        MissingPrerequisiteError: If the kernel has no netem, or this container may not use it.
    """
    iproute2 = Iproute2(run)
    root = next((q for q in iproute2.show("qdisc", "show", "dev", "lo") if q.get("root")), {})
    if root.get("handle", "0:") not in ("0:", _TRIAL):
        return
    if root.get("handle") != _TRIAL:
        iproute2.tc("qdisc", "add", "dev", "lo", "root", "handle", _TRIAL, "netem")
    iproute2.tc("qdisc", "del", "dev", "lo", "root")


def explain(program: str, words: Sequence[str], answer: Answer) -> CloudrcError:
    """Make the error for a failed call: the cause and the remedy."""
    text = answer.error or answer.output
    kind = next((word for word in words if word in ("netem", "prio")), "")
    missing = kind and "change" not in words and "No such file or directory" in text
    if answer.code == NOT_FOUND:
        said = f"no program {program} (package iproute2); install it, or {_INSTEAD}"
    elif missing or "qdisc kind is unknown" in text:
        module = f"sch_{kind or 'netem'}"
        said = (
            f"this kernel has no {module}; {_INSTEAD}, or use nodes whose kernel has it "
            f"('modprobe {module}' there) and a namespace for privileged pods"
        )
    elif "classifier not found" in text:
        said = (
            f"this kernel has neither cls_u32 nor cls_flower; {_INSTEAD}, or use a node whose "
            "kernel has one of them"
        )
    elif "Operation not permitted" in text:
        said = (
            "tc may not change the network of this container; give it NET_ADMIN and uid 0, or "
            f"{_INSTEAD}"
        )
    else:
        line = " ".join(text.split()) or f"exit code {answer.code}"
        said = f"'{program} {' '.join(words)}' failed: {line}; {_INSTEAD}"
    return MissingPrerequisiteError(said)


def may_shape(status: str) -> bool:
    """Return whether a process is root with NET_ADMIN, from the text of its /proc/PID/status.

    Source: Linux, include/uapi/linux/capability.h: CAP_NET_ADMIN is bit 12.
    """
    uid = re.search(r"^Uid:\s+\d+\s+(\d+)", status, re.MULTILINE)
    effective = re.search(r"^CapEff:\s+([0-9a-fA-F]+)", status, re.MULTILINE)
    if uid is None or effective is None:
        return False
    return uid[1] == "0" and bool(int(effective[1], 16) >> 12 & 1)


ENTRIES = 4096
"""Number of entries of a table [1]."""
STRETCH = {"uniform": 1, "normal": 1, "pareto": 4}
"""Distribution -> factor that divides the table's entries, so that the tail fits in 16 bits. The
jitter that tc gets is multiplied by the same factor."""
_ONE = 8192
_END_OF_TABLE = 32_767 / _ONE
"""Largest 16-bit entry, in units of the jitter [1]."""


def _pareto(share: float) -> float:
    survival: float = PARETO_CUT + (1.0 - PARETO_CUT) * (1.0 - share)
    return float(survival ** (-1 / 3))


_QUANTILES: dict[str, Callable[[float], float]] = {
    "uniform": lambda share: 2.0 * share - 1.0,
    "normal": NormalDist().inv_cdf,
    "pareto": _pareto,
}


def table(distribution: str) -> list[int]:
    """Make the table of a distribution: the quantiles at the centres of 4096 equal shares.

    Args:
        distribution: "uniform", in (-1, 1); "normal" or "pareto", mean 0 and standard deviation 1.

    Returns:
        Quantile · 8192 / STRETCH in units of the jitter, rounded, rising, shape (4096,).
    """
    quantile = _QUANTILES[distribution]
    values = [quantile((index + 0.5) / ENTRIES) for index in range(ENTRIES)]
    if distribution != "uniform":
        mean = fmean(values)
        deviation = sqrt(fmean([(value - mean) ** 2 for value in values]))
        values = [(value - mean) / deviation for value in values]
    return [round(value * _ONE / STRETCH[distribution]) for value in values]


def stretch(profile: DirectionProfile) -> int:
    """Return the factor that multiplies the profile's jitter for tc, as in `STRETCH`."""
    if profile.distribution != "table":
        return STRETCH[profile.distribution]
    return ceil(max(map(abs, profile.table)) / _END_OF_TABLE) or 1


def distribution_name(profile: DirectionProfile) -> str:
    """Return tc's name of a profile's distribution: a name in `STRETCH`, or one for its table."""
    if profile.distribution != "table":
        return profile.distribution
    # tc makes a file name of it, so only letters and digits; another table is another file.
    return "table" + blake2b(repr(profile.table).encode(), digest_size=8).hexdigest()


def write_tables(folder: Path) -> None:
    """Write all tables into a folder; tc finds them if TC_LIB_DIR names this folder."""
    for distribution in STRETCH:
        _write(folder, distribution, table(distribution))


def write_measured(folder: Path, profile: DirectionProfile) -> None:
    """Write the table of a profile with a measured distribution; do nothing for other profiles."""
    if profile.distribution == "table":
        unit, values = _ONE / stretch(profile), sorted(profile.table)
        picked = [values[(2 * i + 1) * len(values) // (2 * ENTRIES)] for i in range(ENTRIES)]
        _write(folder, distribution_name(profile), [round(value * unit) for value in picked])


def _write(folder: Path, name: str, entries: Iterable[int]) -> None:
    (folder / f"{name}.dist").write_text("\n".join([f"# {name}", *map(str, entries), ""]))


STEP_NS = 5_000_000
"""Shortest time between two steps of the qdisc [ns]; steps that follow sooner are skipped."""
LIMIT = 10_000
"""Limit of packets in a qdisc without a bottleneck [1], as in the relay."""
DELAY_MAX_NS = 274_000_000_000
"""Longest delay that tc accepts [ns]: ticks of 64 ns in 32 bits."""
_IN_ORDER = "100gbit"
"""Rate that has no effect except that netem keeps the order of packets."""
_ETHERNET_BYTES = 14
"""Length of the Ethernet header, which netem counts and the model does not [bytes]."""
_PACKET_BITS = 8 * 116
"""Size of a command datagram with its headers [bit]; telemetry datagrams are larger."""
_PACKETS = 1_000
"""Assumed packet rate without a bottleneck [1/s], higher than that of a tunnel or a probe."""
_TABLE_END = 4.0
"""Largest entry of a table, in units of the jitter that tc gets [1]."""


def check(profile: DirectionProfile) -> None:
    """Raise a BadInputError if netem cannot realise a profile; the text names the reason."""
    pieces = Timeline(profile).pieces
    if profile.trace is not None and profile.trace.loop:
        _refuse("loop", "a trace that begins again")
    if any(isinstance(piece.loss, GilbertElliott) and piece.loss.delay_bad for piece in pieces):
        _refuse("loss.delay_bad_ms", "more delay while a burst of losses lasts")
    if any(piece.rate and piece.jitter for piece in pieces) and not profile.keep_order:
        _refuse("rate_kbit with jitter_ms but without keep_order", "overtaking behind a bottleneck")
    if (slowest := max(piece.delay_ns for piece in pieces)) > DELAY_MAX_NS:
        _refuse("delay_ms above 274000", f"its clock ends there, here {slowest * 1e-6:g} ms")
    for blackout in profile.blackouts:
        if blackout.duration * 1e9 < STEP_NS:
            _refuse(
                f"blackouts shorter than {STEP_NS * 1e-6:g} ms",
                f"here {blackout.duration * 1e3:g} ms at {blackout.start:g} s",
            )


def _refuse(key: str, meaning: str) -> None:
    raise BadInputError(
        f"netem cannot do {key} ({meaning}); set link.mode=relay, which can, or leave it out"
    )


def notes(profile: DirectionProfile) -> list[str]:
    """Return notes about the parts of a profile that netem realises differently."""
    said = []
    if profile.jitter and profile.correlation:
        said.append(f"netem realises next to nothing of correlation {profile.correlation:g}")
    if profile.corrupt:
        said.append(
            "netem corrupts frames, not datagrams: the receiving kernel drops most of them by "
            f"their checksums, so that corrupt {profile.corrupt:g} is seen as loss"
        )
    starts = Timeline(profile).pass_ns
    passed_over = sum(after - before < STEP_NS for before, after in pairwise(starts))
    if passed_over:
        said.append(
            f"netem is stepped every {STEP_NS * 1e-6:g} ms at most: {passed_over} of "
            f"{len(starts)} steps of the time line come sooner, and some are passed over"
        )
    return said


def options(profile: DirectionProfile, conditions: Conditions, room: int) -> list[str]:
    """Translate the conditions at one instant into options of netem.

    Args:
        profile: A profile that has passed `check`.
        conditions: Conditions at this instant.
        room: Limit of the qdisc [packets].

    Returns:
        Arguments for `tc qdisc add|change ... netem`.
    """
    words = ["limit", str(room), "delay", _microseconds(conditions.delay_ns)]
    if conditions.jitter:
        words += [_microseconds(conditions.jitter * 1e9 * stretch(profile))]
        words += [_percent(profile.correlation), "distribution", distribution_name(profile)]
    words += ["loss", *_loss(1.0 if conditions.blackout else conditions.loss)]
    # Of a packet that is doubled and lost one copy arrives: in a blackout none may.
    copied = 0.0 if conditions.blackout else profile.duplicate
    words += ["duplicate", _percent(copied), "corrupt", _percent(profile.corrupt)]
    # tc refuses it without a delay, where there is nothing to overtake.
    if profile.reorder and conditions.delay_ns and not profile.keep_order:
        words += ["reorder", _percent(profile.reorder)]
    if conditions.rate is not None:
        return [*words, "rate", f"{conditions.rate:.0f}bit", str(-_ETHERNET_BYTES)]
    # 0 takes back a rate that was given before.
    return [*words, "rate", _IN_ORDER if profile.keep_order else "0bit"]


def limit(profile: DirectionProfile) -> int:
    """Return the limit of the qdisc: packets under way plus the queue of a bottleneck [packets].

    The limit is the same along the whole time line. Otherwise a step to a shorter delay would drop
    packets, because packets with the longer delay are still under way.
    """
    pieces = Timeline(profile).pieces
    if all(piece.rate is None for piece in pieces):
        return LIMIT
    reach, most = stretch(profile) * _TABLE_END, 0.0
    for piece in pieces:
        longest = piece.delay_ns * 1e-9 + piece.jitter * reach
        most = max(most, longest * (piece.rate / _PACKET_BITS if piece.rate else _PACKETS))
    return ceil(profile.queue_packets + most)


def _loss(loss: Loss) -> list[str]:
    if isinstance(loss, GilbertElliott):
        chances = (loss.bad_start, loss.bad_end, loss.loss_bad, loss.loss_good)
        return ["gemodel", *map(_percent, chances)]
    return ["random", _percent(loss)]


def _microseconds(duration_ns: float) -> str:
    return f"{duration_ns * 1e-3:.3f}us"  # iproute2 before 6.2 knows no "ns"


def _percent(share: float) -> str:
    return f"{100.0 * share:.9g}%"
