# SPDX-License-Identifier: Apache-2.0

"""The sidecar's decisions and its state, with shapers that only record their calls."""

import json
import re

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link.follow import Loaded
from cloudrc.link.sidecar import Sidecar
from cloudrc.link.state import ChangeFacts
from tests.link.profiles import profile_of

PEER, NEXT = ("10.244.0.7", 7400), ("10.244.0.9", 7400)
REFUSED = BadInputError("netem cannot do delay_ms above 274000 (far)", fix="set link.mode=relay")
NO_NETEM = MissingPrerequisiteError("no sch_netem; no sch_prio", fix="set link.mode=relay")


class Shaper:
    def __init__(self, bench, name, refuses=None):
        self.name, self._bench, self._refuses = name, bench, refuses

    def follow_peer(self, peer):
        if self._refuses:
            raise self._refuses
        self._bench.did.append(f"{self.name} {peer[0]}")
        return peer if self.name == "netem" else ("127.0.0.1", 7401)

    def follow_profile(self, profile, *, restart=False, start_ns=0):
        if self.name == "netem" and profile.delay_ms == 9e3:
            raise REFUSED
        self._bench.did.append(
            f"{self.name} {1e-3 * profile.delay_ms:g} s{' from now' if restart else ''}"
        )

    def step(self, timeout):
        assert timeout <= 0.1
        self._bench.wait(timeout)

    def counts(self):
        return {"forwarded": len(self._bench.did)}

    def released(self):
        return {"released": 1, "overflow": 0} if self.name == "relay" else {}

    def close(self):
        self._bench.did.append(f"{self.name} closes")


class Bench:
    """A sidecar whose time passes in `wait`, which runs the planned events."""

    def __init__(self, folder, mode, refuses=None):
        self.did, self.log, self.routes, self.plan, self.now_ns = [], [], [], [], 0
        self.counted_ns, self.origins_ns = [], []
        self.route, self.state = folder / "route", folder / "link.json"

        def relay(asked, origin_ns):
            self.origins_ns.append(origin_ns)
            return Shaper(self, "relay")

        def netem(asked, origin_ns):
            self.origins_ns.append(origin_ns)
            return Shaper(self, "netem", REFUSED if asked.delay_ms == 9e3 else refuses)

        self.sidecar = Sidecar(
            relay=relay,
            netem=netem,
            clock=lambda: self.now_ns,
            wait=self.wait,
            log=self.log.append,
            profile=Loaded(profile_of(), {"description": "nothing"}),
            mode=mode,
            direction="uplink",
            route=self.route,
            tell=self.tell,
            count=lambda counts: self.counted_ns.append(self.now_ns),
            peer=PEER,
        )

    def at(self, time, action):
        self.plan.append((time, action))

    def wait(self, duration):
        self.now_ns += round(duration * 1e9)
        for entry in [one for one in self.plan if one[0] * 1e9 <= self.now_ns]:
            self.plan.remove(entry)
            entry[1]()

    def run(self, until=3.0):
        self.at(until - 1.0, lambda: self.routes.append(self.route.read_text()))
        self.sidecar.run(lambda: self.now_ns >= until * 1e9)
        return self

    def tell(self, state):
        assert self.route.exists()
        self.did.append(f"metric {state.shaper}")

    def replace(self, delay, change=ChangeFacts()):  # noqa: B008
        values = {"description": f"{delay:g} s"}
        self.sidecar.profile = Loaded(profile_of(delay), values, change)

    def told(self):
        return json.loads(self.state.read_text())


def test_relay_touches_no_netem_and_leaves_no_route(tmp_path):
    bench = Bench(tmp_path, "relay", refuses=AssertionError("touched"))
    bench.at(3.0, bench.sidecar.publish_released)
    bench.at(3.5, lambda: bench.routes.append((tmp_path / "link.released").read_text()))
    bench.run(5.05)
    assert bench.routes == ['{"released": 1, "overflow": 0}', "127.0.0.1:7401\n"]
    assert bench.did == ["relay 10.244.0.7", "metric relay", "relay closes"]
    assert bench.log == ["relay shapes the uplink (link.mode=relay)"]
    assert [path.name for path in tmp_path.iterdir()] == ["link.json"]
    assert np.diff(bench.counted_ns) == pytest.approx(1e9, abs=0.1e9)


def test_a_schedule_begins_where_it_is_asked_to_and_the_log_says_so(tmp_path):
    bench = Bench(tmp_path, "relay")
    bench.sidecar.profile = Loaded(profile_of(), {}, start_ns=7, note="begins at 7 ns")
    assert bench.run().origins_ns == [-7]
    assert bench.log[0] == "begins at 7 ns"


def test_auto_takes_netem_where_it_works(tmp_path):
    bench = Bench(tmp_path, "auto").run()
    assert bench.routes == ["10.244.0.7:7400\n"]
    expected = {"shaper": "netem", "reason": "link.mode=auto", "mode": "auto", "origin_ns": 0}
    expected |= {"direction": "uplink", "profile": {"description": "nothing"}, "changes": 0}
    assert expected.items() <= bench.told().items()


@pytest.mark.parametrize(
    ("refuses", "reason"),
    [
        (NO_NETEM, "no sch_netem; no sch_prio"),
        (REFUSED, "netem cannot do delay_ms above 274000 (far)"),
    ],
)
def test_where_netem_fails_auto_takes_the_relay_and_netem_ends(tmp_path, refuses, reason):
    told = Bench(tmp_path, "auto", refuses).run().told()
    said = f"netem does not work here: {reason}"
    assert (told["shaper"], told["reason"]) == ("relay", said)
    bench = Bench(tmp_path, "netem", refuses)
    with pytest.raises((MissingPrerequisiteError, BadInputError), match=re.escape(reason)):
        bench.run()
    assert not bench.route.exists()


@pytest.mark.fault(
    19,
    "dns-failure",
    injects="the peer's name does not resolve at first, later it has a new address",
    expects="the link waits, then follows the address; its schedule keeps its start",
    figures="2 s without an address",
)
def test_the_peer_is_waited_for_and_its_new_address_followed(tmp_path):
    """The schedule keeps its start when another shaper takes over."""
    bench = Bench(tmp_path, "auto")
    bench.route.write_text("10.0.0.1:7400\n")  # an earlier process was killed
    bench.sidecar.peer = None
    bench.at(1.0, lambda: bench.did.append(str(bench.route.exists())))
    bench.at(2.0, lambda: setattr(bench.sidecar, "peer", PEER))
    bench.at(2.5, lambda: setattr(bench.sidecar, "peer", NEXT))
    bench.at(5.0, lambda: bench.replace(9.0, ChangeFacts("c3", "for the relay", restart=False)))
    bench.at(4.0, lambda: bench.routes.append(bench.route.read_text()))
    bench.run(7.0)
    assert bench.routes == ["10.244.0.9:7400\n", "127.0.0.1:7401\n"]
    assert bench.did[:4] == ["False", "netem 10.244.0.7", "metric netem", "netem 10.244.0.9"]
    assert bench.told()["shaper"] == "relay"
    assert len(set(bench.origins_ns)) == 1
    assert 2.0e9 <= bench.origins_ns[0] < 2.2e9


def test_a_new_profile_is_followed_within_a_step(tmp_path):
    bench = Bench(tmp_path, "relay")
    states = []
    by_hand = ChangeFacts("a1", "downlink.delay_ms=500", restart=False)
    bench.at(1.0, lambda: bench.replace(0.5, by_hand))
    bench.at(1.5, lambda: states.append(bench.told()))
    bench.at(2.0, lambda: bench.replace(0.1))
    bench.run()
    assert bench.did[2:5] == ["relay 0.5 s", "metric relay", "relay 0.1 s from now"]
    (state,) = states
    assert (state["change"], state["cause"], state["changes"]) == ("a1", by_hand.cause, 1)
    assert state["profile"] == {"description": "0.5 s"}
    assert state["asked"] == {"delay": 0.5, "jitter": 0.0, "loss": 0.0, "rate": None}
    assert 1.0e9 <= state["since_ns"] <= 1.2e9
    assert state["origin_ns"] == 0, "the schedule goes on"
    assert bench.told()["cause"] == "the profile's file changed"
    assert 2.0e9 <= bench.told()["origin_ns"] <= 2.2e9


def test_a_profile_netem_cannot_do_is_refused_or_relayed(tmp_path):
    netem, auto = Bench(tmp_path, "netem"), Bench(tmp_path, "auto")
    netem.at(1.0, lambda: netem.replace(9.0, ChangeFacts("b2", "far")))
    told = netem.run().told()
    assert (told["shaper"], told["changes"], told["refused"]) == ("netem", 0, "b2")
    assert "netem cannot do delay_ms" in told["refusal"]
    auto.at(1.0, lambda: auto.replace(9.0, ChangeFacts("b2", "far")))
    told = auto.run().told()
    assert any("netem cannot do delay_ms" in line for line in auto.log)
    assert (told["shaper"], told["changes"], told["refused"]) == ("relay", 1, "")
    assert 1.0e9 <= told["origin_ns"] <= 1.2e9, "the relay begins the schedule anew"
