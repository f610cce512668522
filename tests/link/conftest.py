"""Fixtures of the link: packets over a model, a fake tc kernel, a netem laboratory, a fake sidecar.

The laboratory joins two network namespaces by a cable for tests of real netem. The sidecar's
shapers only store calls, on a clock that a test moves.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.link.follow import Loaded
from cloudrc.link.netem import Answer, Netem
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Machine, Mode, Settings, Sidecar
from cloudrc.link.state import Change

SIZE = 172
"""Length of a datagram, about that of telemetry [bytes]."""
PEER = ("10.244.0.7", 7400)
UNKNOWN = Answer(2, "", "Error: Specified qdisc kind is unknown.\n")
NO_QDISC = Answer(2, "", "Error: No such file or directory.\n")
NO_CLASSIFIER = Answer(
    2, "", "Error: TC classifier not found.\nWe have an error talking to the kernel\n"
)


class Kernel:
    """An interface with its qdiscs and filters."""

    def __init__(self, *lacks: str) -> None:
        self.lacks = lacks
        self.held = 4
        self.said: list[str] = []
        self.refuses = "nothing"
        self.clear()

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
                self.clear()
            case ["tc", "qdisc", verb, *rest]:
                kind = "netem" if "netem" in rest else "prio"
                if kind in self.lacks:
                    return UNKNOWN
                if self.refuses in rest:
                    return Answer(1, "", "Illegal delay")
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
        leaf["options"] = listing(self.netem or [])
        return [self.root, *([leaf] if self.netem is not None else [])]

    def clear(self) -> None:
        self.root = {"kind": "noqueue", "handle": "0:", "root": True}
        self.netem: list[str] | None = None
        self.filters: dict[int, str] = {}


def listing(words: Sequence[str]) -> dict[str, object]:
    """Return the "options" that `tc -j qdisc show` prints for the words of a netem command."""
    given = dict(pairwise(words))
    delay = float(given.get("delay", "0us").removesuffix("us")) * 1e-6
    return {"limit": int(given.get("limit", 1000)), "delay": {"delay": delay}, "words": words}


class Clock:
    now_ns = 0

    def __call__(self) -> int:
        return self.now_ns

    def wait(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9)


def netem(
    kernel: Kernel,
    profile: DirectionProfile,
    clock: Clock | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> Netem:
    clock = clock or Clock()
    return Netem(kernel.run, profile, origin_ns=0, clock=clock, wait=clock.wait, log=log)


REFUSED = BadInputError("netem cannot do delay_ms above 274000 (far); set link.mode=relay")


class Shaper:
    def __init__(self, bench: Bench, name: str, refuses: Exception | None = None) -> None:
        self.name = name
        self._bench = bench
        self._refuses = refuses

    def follow_peer(self, peer: tuple[str, int]) -> tuple[str, int]:
        if self._refuses:
            raise self._refuses
        self._bench.did.append(f"{self.name} {peer[0]}")
        return peer if self.name == "netem" else ("127.0.0.1", 7401)

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        if self.name == "netem" and profile.delay == 9.0:
            raise REFUSED
        again = " from now" if restart else ""
        self._bench.did.append(f"{self.name} {profile.delay:g} s{again}")

    def step(self, timeout: float) -> None:
        assert timeout <= 0.1
        self._bench.wait(timeout)

    def counts(self) -> dict[str, int]:
        return {"forwarded": len(self._bench.did)}

    def released(self) -> dict[str, int]:
        return {"released": 1, "overflow": 0} if self.name == "relay" else {}

    def close(self) -> None:
        self._bench.did.append(f"{self.name} closes")


class Bench:
    """A sidecar whose time passes in `wait`, which runs the planned events."""

    def __init__(
        self,
        folder: Path,
        mode: Mode,
        refuses: Exception | None = None,
        may_shape: bool = True,
        profile: DirectionProfile | None = None,
    ) -> None:
        self.did: list[str] = []
        self.log: list[str] = []
        self.now_ns = 0
        self.plan: list[tuple[float, Callable[[], None]]] = []
        self.counted_ns: list[int] = []
        self.origins_ns: list[int] = []
        self.delays: list[float] = []
        self.route, self.state = folder / "route", folder / "link.json"
        machine = Machine(
            relay=lambda _, origin_ns: self.make("relay", origin_ns),
            netem=lambda asked, origin_ns: self.make(
                "netem", origin_ns, REFUSED if asked.delay == 9.0 else refuses
            ),
            may_shape=may_shape,
            clock=lambda: self.now_ns,
            today=lambda: "2026-01-02T03:04:05+00:00",
            wait=self.wait,
            log=self.log.append,
        )
        settings = Settings(mode, "uplink", self.route, self.state)
        loaded = Loaded(profile or DirectionProfile(), {"description": "nothing"})
        self.sidecar = Sidecar(settings, machine, loaded, self)
        self.sidecar.peer = PEER

    def make(self, name: str, origin_ns: int, refuses: Exception | None = None) -> Shaper:
        self.origins_ns.append(origin_ns)
        return Shaper(self, name, refuses)

    def at(self, time: float, action: Callable[[], None]) -> None:
        self.plan.append((time, action))

    def wait(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9)
        for entry in [one for one in self.plan if one[0] * 1e9 <= self.now_ns]:
            self.plan.remove(entry)
            entry[1]()

    def run(self, until: float = 3.0) -> Bench:
        self.sidecar.run(lambda: self.now_ns >= until * 1e9)
        return self

    def shapes(self, shaper: str) -> None:
        self.did.append(f"metric {shaper}")

    def asked(self, delay: float) -> None:
        self.delays.append(delay)

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        self.counted_ns.append(stamp_ns)

    def replace(self, delay: float, change: Change = Change()) -> None:  # noqa: B008
        values = {"description": f"{delay:g} s"}
        self.sidecar.profile = Loaded(DirectionProfile(delay), values, change)


def told(bench: Bench) -> dict[str, object]:
    found: dict[str, object] = json.loads(bench.state.read_text())
    return found
