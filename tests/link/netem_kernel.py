"""A kernel with one interface, as far as tc sees it, and a netem on it whose time is a number."""

from __future__ import annotations

import json
from collections.abc import Sequence

from cloudrc.link.netem import Netem
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.tc import Answer

PEER = ("10.244.0.7", 7400)
UNKNOWN = Answer(2, "", "Error: Specified qdisc kind is unknown.\n")
NO_QDISC = Answer(2, "", "Error: No such file or directory.\n")
NO_CLASSIFIER = Answer(
    2, "", "Error: TC classifier not found.\nWe have an error talking to the kernel\n"
)


class Kernel:
    """One interface, and the qdiscs and filters on it."""

    def __init__(self, *lacks: str) -> None:
        self.lacks = lacks
        self.held = 4
        self.said: list[str] = []
        self.clamps: dict[str, object] = {}
        self._clear()

    def run(self, words: Sequence[str]) -> Answer:
        line = " ".join(words)
        if not line.startswith(("tc -s -j", "ip")):
            self.said.append(line.removeprefix("tc ").replace("dev eth0 ", ""))
        match words:
            case ["ip", *_]:
                return Answer(0, '[{"dst":"10.244.0.7","dev":"eth0","flags":[]}]', "")
            case ["tc", "-s", "-j", "qdisc", *_]:
                return Answer(0, json.dumps(self.qdiscs()), "")
            case ["tc", "-s", "-j", "filter", *_]:
                entries = [{"pref": number, "kind": "u32"} for number in self.filters]
                return Answer(0, json.dumps(entries * 2), "")
            case ["tc", "qdisc", "del", *_]:
                self._clear()
            case ["tc", "qdisc", verb, *rest]:
                kind = "netem" if "netem" in rest else "prio"
                if kind in self.lacks:
                    return UNKNOWN
                if kind == "prio":
                    self.root = {"kind": "prio", "handle": "7400:", "root": True}
                else:
                    if verb == "change" and self.netem is None:
                        return NO_QDISC
                    assert (verb == "add") is (self.netem is None)
                    self.netem = list(rest[rest.index("netem") + 1 :])
            case ["tc", "filter", "add", "dev", _, "parent", _, "pref", number, *rest]:
                if rest[2] in self.lacks:
                    return NO_CLASSIFIER
                assert int(number) not in self.filters
                self.filters[int(number)] = " ".join(rest)
            case ["tc", "filter", "del", *_, number]:
                del self.filters[int(number)]
        return Answer(0, "", "")

    def qdiscs(self) -> list[dict[str, object]]:
        leaf = {"kind": "netem", "handle": "7401:", "packets": 90, "drops": 10}
        leaf["qlen"] = self.held
        leaf["options"] = {**listing(self.netem or []), **self.clamps}
        return [self.root, *([leaf] if self.netem is not None else [])]

    def _clear(self) -> None:
        self.root = {"kind": "noqueue", "handle": "0:", "root": True}
        self.netem: list[str] | None = None
        self.filters: dict[int, str] = {}


def listing(words: Sequence[str]) -> dict[str, object]:
    """The "options" that `tc -j qdisc show` prints for words that netem was given."""
    text = " ".join(words)
    found: dict[str, object] = {"limit": int(words[words.index("limit") + 1]) if words else 1000}
    for name, key, unit in (("delay", "delay", 1e-6), ("duplicate", "duplicate", 0.01),
                            ("corrupt", "corrupt", 0.01), ("random", "loss-random", 0.01),
                            ("rate", "rate", 0.125)):  # fmt: skip
        if name in words:
            number = float(text.split(f"{name} ")[1].split(" ")[0].rstrip("usbitg%"))
            scale = unit * (1e9 if f"{name} 100gbit" in text else 1.0)
            found[key] = {"loss" if key == "loss-random" else key: number * scale}
    return found


class Clock:
    now_ns = 0

    def __call__(self) -> int:
        return self.now_ns

    def wait(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9)


def netem(kernel: Kernel, profile: DirectionProfile, clock: Clock | None = None) -> Netem:
    clock = clock or Clock()
    return Netem(kernel.run, profile, origin_ns=0, clock=clock, wait=clock.wait)
