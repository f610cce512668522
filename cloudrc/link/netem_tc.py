"""How iproute2 is asked and understood: argument lists go to a runner, answers come out as data.

Nothing here starts a process: whoever has the right to, passes the runner in.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

from cloudrc.errors import CloudrcError, MissingPrerequisiteError

_TRIAL = "7402:"
_INSTEAD = "set link.mode=relay, which needs nothing of the kernel"


class Answer(NamedTuple):
    """What a program said: its exit code, standard output and standard error."""

    code: int
    output: str
    error: str


Run: TypeAlias = Callable[[Sequence[str]], Answer]
"""Runs a program to its end; 127 is the code of one that is not there."""


class Iproute2:
    """`tc` and `ip`, each call checked."""

    def __init__(self, run: Run) -> None:
        self._run = run

    def tc(self, *words: str) -> str:
        """Run tc and return its output; raises as `explain` says."""
        return self._checked("tc", words)

    def show(self, *words: str) -> list[dict[str, Any]]:
        """Run `tc -s -j` with these words and return the objects that it prints."""
        return list(json.loads(self._checked("tc", ("-s", "-j", *words)) or "[]"))

    def device(self, host: str) -> str:
        """Name the interface over which an address is reached."""
        routes = json.loads(self._checked("ip", ("-j", "route", "get", host)))
        return str(routes[0]["dev"])

    def _checked(self, program: str, words: Sequence[str]) -> str:
        answer = self._run((program, *words))
        if answer.code:
            raise explain(program, words, answer)
        return answer.output


def try_netem(run: Run) -> None:
    """Find out whether this kernel has netem, by a qdisc on the loopback that delays nothing.

    A qdisc of somebody else is left alone: then nothing is found out.

    Raises:
        MissingPrerequisiteError: If there is none, or this container may not use it.
    """
    iproute2 = Iproute2(run)
    root = next((q for q in iproute2.show("qdisc", "show", "dev", "lo") if q.get("root")), {})
    if root.get("handle", "0:") not in ("0:", _TRIAL):
        return
    if root.get("handle") != _TRIAL:
        iproute2.tc("qdisc", "add", "dev", "lo", "root", "handle", _TRIAL, "netem")
    iproute2.tc("qdisc", "del", "dev", "lo", "root")


def explain(program: str, words: Sequence[str], answer: Answer) -> CloudrcError:
    """Put an answer that is not the wanted one into words: the cause, and what to do."""
    text = answer.error or answer.output
    kind = _kind(words)
    if answer.code == 127:
        return MissingPrerequisiteError(
            f"no program {program} (package iproute2); install it, or {_INSTEAD}"
        )
    missing = kind and "change" not in words and "No such file or directory" in text
    if missing or "qdisc kind is unknown" in text:
        return MissingPrerequisiteError(
            f"this kernel has no sch_{kind or 'netem'}; {_INSTEAD}, or use nodes whose kernel has "
            f"it ('modprobe sch_{kind or 'netem'}' there) and a namespace for privileged pods"
        )
    if "classifier not found" in text:
        return MissingPrerequisiteError(
            f"this kernel has neither cls_u32 nor cls_flower; {_INSTEAD}, or use a node whose "
            "kernel has one of them"
        )
    if "Operation not permitted" in text:
        return MissingPrerequisiteError(
            f"tc may not change the network of this container; give it NET_ADMIN and uid 0, or "
            f"{_INSTEAD}"
        )
    line = " ".join(text.split()) or f"exit code {answer.code}"
    return MissingPrerequisiteError(f"'{program} {' '.join(words)}' failed: {line}; {_INSTEAD}")


def may_shape(status: str) -> bool:
    """Say whether a process is root with NET_ADMIN, from the text of its /proc/PID/status.

    Source: Linux, include/uapi/linux/capability.h: CAP_NET_ADMIN is bit 12.
    """
    uid = re.search(r"^Uid:\s+\d+\s+(\d+)", status, re.MULTILINE)
    effective = re.search(r"^CapEff:\s+([0-9a-fA-F]+)", status, re.MULTILINE)
    if uid is None or effective is None:
        return False
    return uid[1] == "0" and bool(int(effective[1], 16) >> 12 & 1)


def _kind(words: Sequence[str]) -> str:
    """Name the kind of qdisc that a command is about, if it is about one."""
    return next((word for word in words if word in ("netem", "prio")), "")
