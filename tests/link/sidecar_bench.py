"""A sidecar with shapers that only take notes, on a clock that only it moves."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.link.follow import Loaded
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Machine, Mode, Settings, Sidecar
from cloudrc.link.state import Change

PEER = ("10.244.0.7", 7400)
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
    """A sidecar whose time passes in `wait`, where what is planned happens."""

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
        self.no_netem: Exception | None = None
        self.route, self.state = folder / "route", folder / "link.json"
        machine = Machine(
            relay=lambda _, origin_ns: self.make("relay", origin_ns),
            netem=lambda asked, origin_ns: self.make(
                "netem", origin_ns, REFUSED if asked.delay == 9.0 else refuses
            ),
            may_shape=may_shape,
            try_netem=self.try_netem,
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

    def try_netem(self) -> None:
        if self.no_netem:
            raise self.no_netem

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
