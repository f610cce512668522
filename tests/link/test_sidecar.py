"""The sidecar's decisions, with shapers that only take notes."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Machine, Mode, Settings, Sidecar
from cloudrc.link.sidecar_follow import Loaded
from cloudrc.link.state import Change

PEER, NEXT = ("10.244.0.7", 7400), ("10.244.0.9", 7400)
NO_NETEM = MissingPrerequisiteError("this kernel has no sch_netem; set link.mode=relay")
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


def test_relay_touches_no_netem_and_leaves_no_route(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay", refuses=AssertionError("touched"))
    routes: list[str] = []
    bench.at(1.0, lambda: routes.append(bench.route.read_text()))
    bench.run()
    assert routes == ["127.0.0.1:7401\n"]
    assert bench.did == ["relay 10.244.0.7", "metric relay", "relay closes"]
    assert bench.log == ["relay shapes the uplink (link.mode=relay)"]
    assert not bench.route.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.json"]


def test_auto_takes_netem_where_it_works(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "auto")
    routes: list[str] = []
    bench.at(1.0, lambda: routes.append(bench.route.read_text()))
    bench.run()
    assert routes == ["10.244.0.7:7400\n"]
    assert told(bench) == {
        "shaper": "netem",
        "reason": "link.mode=auto",
        "mode": "auto",
        "direction": "uplink",
        "profile": {"description": "nothing"},
        "since": "2026-01-02T03:04:05+00:00",
        "since_ns": 0,
        "changes": 0,
        "change": "",
        "cause": "",
        "asked": {"delay": 0.0, "jitter": 0.0, "loss": 0.0, "rate": None},
        "origin_ns": 0,
        "refused": "",
        "refusal": "",
    }


@pytest.mark.parametrize(
    ("refuses", "may_shape", "reason"),
    [
        (NO_NETEM, True, "this kernel has no sch_netem"),
        (REFUSED, True, "netem cannot do delay_ms above 274000 (far)"),
        (None, False, "no uid 0 with NET_ADMIN"),
    ],
)
def test_auto_takes_the_relay_where_it_does_not_and_says_why(
    tmp_path: Path, refuses: Exception | None, may_shape: bool, reason: str
) -> None:
    bench = Bench(tmp_path, "auto", refuses, may_shape).run()
    reason = f"netem does not work here: {reason}"
    assert bench.log == [f"relay shapes the uplink ({reason})"]
    assert (told(bench)["shaper"], told(bench)["reason"]) == ("relay", reason)


@pytest.mark.parametrize(
    ("refuses", "may_shape", "words"),
    [
        (NO_NETEM, True, "no sch_netem; set"),
        (REFUSED, True, "cannot do delay_ms"),
        (None, False, "needs uid 0 and NET_ADMIN"),
    ],
)
def test_netem_is_strict(
    tmp_path: Path, refuses: Exception | None, may_shape: bool, words: str
) -> None:
    bench = Bench(tmp_path, "netem", refuses, may_shape)
    with pytest.raises((MissingPrerequisiteError, BadInputError), match=words):
        bench.run()
    assert bench.did == []
    assert not bench.route.exists()


def test_nothing_is_told_before_the_peer_is_known(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay")
    bench.route.write_text("10.0.0.1:7400\n")  # an earlier process was killed
    bench.sidecar.peer = None
    bench.at(1.0, lambda: bench.did.append(str(bench.route.exists())))
    bench.at(2.0, lambda: setattr(bench.sidecar, "peer", PEER))
    bench.run()
    assert bench.did[:2] == ["False", "relay 10.244.0.7"]
    bench = Bench(tmp_path, "relay")
    bench.sidecar.peer = None
    assert bench.run().did == []


def test_a_new_address_is_followed_and_told(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "netem")
    routes: list[str] = []
    bench.at(1.0, lambda: setattr(bench.sidecar, "peer", NEXT))
    bench.at(1.2, lambda: routes.append(bench.route.read_text()))
    assert bench.run().did[2] == "netem 10.244.0.9"
    assert routes == ["10.244.0.9:7400\n"]


def test_a_new_profile_is_followed_within_a_step(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay")
    bench.at(1.0, lambda: bench.replace(0.5))
    bench.at(1.15, lambda: bench.did.append("later"))
    assert bench.run().did[2:4] == ["relay 0.5 s from now", "later"]
    state = told(bench)
    assert state["profile"] == {"description": "0.5 s"}
    assert (state["changes"], state["cause"]) == (1, "the profile's file changed")
    assert state["asked"] == {"delay": 0.5, "jitter": 0.0, "loss": 0.0, "rate": None}
    assert bench.delays == [0.0, 0.5]


def test_who_changed_the_profile_is_told_once_and_may_let_its_time_line_go_on(
    tmp_path: Path,
) -> None:
    bench = Bench(tmp_path, "relay")
    states: list[dict[str, object]] = []
    by_hand = Change("a1", "downlink.delay_ms=500", restart=False)
    bench.at(1.0, lambda: bench.replace(0.5, by_hand))
    bench.at(1.5, lambda: states.append(told(bench)))
    bench.at(2.0, lambda: bench.replace(0.1, by_hand))  # helm changed the file, the note stayed
    bench.run()
    assert [one for one in bench.did if " s" in one] == ["relay 0.5 s", "relay 0.1 s from now"]
    assert (states[0]["change"], states[0]["cause"]) == ("a1", "downlink.delay_ms=500")
    assert 1.0e9 <= float(str(states[0]["since_ns"])) <= 1.2e9
    assert told(bench)["cause"] == "the profile's file changed"


def test_a_change_that_is_refused_is_told_with_its_number(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "netem")
    bench.at(1.0, lambda: bench.replace(9.0, Change("b2", "far", restart=True)))
    state = told(bench.run())
    assert (state["changes"], state["refused"]) == (0, "b2")
    assert "netem cannot do delay_ms" in str(state["refusal"])


def test_strict_netem_fails_before_anybody_is_waited_for(tmp_path: Path) -> None:
    for no_netem, profile, words in (
        (NO_NETEM, None, "no sch_netem; set"),
        (None, DirectionProfile(300.0), "delay_ms above 274000"),
    ):
        bench = Bench(tmp_path, "netem", profile=profile)
        bench.sidecar.peer, bench.no_netem = None, no_netem
        with pytest.raises((MissingPrerequisiteError, BadInputError), match=words):
            bench.run()
        assert bench.now_ns == 0


def test_the_time_line_counts_from_when_the_link_came_up(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "auto")
    bench.sidecar.peer = None
    bench.at(2.0, lambda: setattr(bench.sidecar, "peer", PEER))
    bench.at(2.5, lambda: bench.replace(9.0, Change("c3", "for the relay", restart=False)))
    bench.run()
    assert len(set(bench.origins_ns)) == 1
    assert 2.0e9 <= bench.origins_ns[0] < 2.2e9


def test_a_profile_that_netem_cannot_do_is_refused_or_takes_the_relay(tmp_path: Path) -> None:
    for mode, did in (("netem", "netem closes"), ("auto", "relay closes")):
        bench = Bench(tmp_path, mode)  # type: ignore[arg-type]
        bench.at(1.0, lambda bench=bench: bench.replace(9.0))  # type: ignore[misc]
        assert bench.run().did[-1] == did
        assert any("netem cannot do delay_ms" in line for line in bench.log)
        assert told(bench)["shaper"] == did.split()[0]


def test_it_counts_once_a_second(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay").run(until=5.05)
    at = [at_ns * 1e-9 for at_ns in bench.counted_ns]
    assert at[0] < 0.2
    assert [later - one for one, later in pairwise(at)] == pytest.approx([1.0] * 5, abs=0.1)
