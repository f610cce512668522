"""The sidecar's decisions, with shapers that only take notes; and what it tells `link verify`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from errno import ENOSPC
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli.link_run import EMPTY_STATUS, LinkStatusSource
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.link import sidecar
from cloudrc.link.follow import Loaded
from cloudrc.link.netem import Answer, notes
from cloudrc.link.profile import Blackout, DirectionProfile, GilbertElliott, Trace
from cloudrc.link.profile import Change as Step
from cloudrc.link.sidecar import Mode, Near, Told, look_near, read_told, write_told
from cloudrc.link.state import Change, publish
from tests.link.conftest import PEER, REFUSED, Bench, told

NEXT = ("10.244.0.9", 7400)
NO_NETEM = MissingPrerequisiteError("this kernel has no sch_netem; set link.mode=relay")


def test_relay_touches_no_netem_and_leaves_no_route(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay", refuses=AssertionError("touched"))
    routes: list[str] = []
    bench.at(1.0, lambda: routes.append(bench.route.read_text()))
    bench.run()
    assert routes == ["127.0.0.1:7401\n"]
    assert bench.did == ["relay 10.244.0.7", "metric relay", "relay closes"]
    assert bench.log == ["relay shapes the uplink (link.mode=relay)"]
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


CANNOT = [
    (NO_NETEM, True, "this kernel has no sch_netem"),
    (REFUSED, True, "netem cannot do delay_ms above 274000 (far)"),
    (None, False, "no uid 0 with NET_ADMIN"),
]


@pytest.mark.parametrize(("refuses", "may_shape", "reason"), CANNOT)
def test_auto_takes_the_relay_elsewhere_and_says_why(
    tmp_path: Path, refuses: Exception | None, may_shape: bool, reason: str
) -> None:
    bench = Bench(tmp_path, "auto", refuses, may_shape).run()
    reason = f"netem does not work here: {reason}"
    assert bench.log == [f"relay shapes the uplink ({reason})"]
    assert (told(bench)["shaper"], told(bench)["reason"]) == ("relay", reason)


@pytest.mark.parametrize(("refuses", "may_shape", "_"), CANNOT)
def test_netem_is_strict(
    tmp_path: Path, refuses: Exception | None, may_shape: bool, _: str
) -> None:
    bench = Bench(tmp_path, "netem", refuses, may_shape)
    words = "sch_netem; set|cannot do delay_ms|no uid 0 with NET_ADMIN"
    with pytest.raises((MissingPrerequisiteError, BadInputError), match=words):
        bench.run()
    assert bench.did == []
    assert not bench.route.exists()


def test_nothing_is_published_before_the_peer_is_known(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay")
    bench.route.write_text("10.0.0.1:7400\n")  # an earlier process was killed
    bench.sidecar.peer = None
    bench.at(1.0, lambda: bench.did.append(str(bench.route.exists())))
    bench.at(2.0, lambda: setattr(bench.sidecar, "peer", PEER))
    bench.run()
    assert bench.did[:2] == ["False", "relay 10.244.0.7"]


def test_a_new_address_is_followed_and_published(tmp_path: Path) -> None:
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


def test_a_change_by_hand_may_continue_the_time_line(tmp_path: Path) -> None:
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


def test_the_time_line_counts_from_when_the_link_came_up(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "auto")
    bench.sidecar.peer = None
    bench.at(2.0, lambda: setattr(bench.sidecar, "peer", PEER))
    bench.at(2.5, lambda: bench.replace(9.0, Change("c3", "for the relay", restart=False)))
    bench.run()
    assert len(set(bench.origins_ns)) == 1
    assert 2.0e9 <= bench.origins_ns[0] < 2.2e9


@pytest.mark.parametrize(("mode", "left"), [("netem", "netem"), ("auto", "relay")])
def test_a_profile_netem_cannot_do_is_refused_or_relayed(
    tmp_path: Path, mode: Mode, left: str
) -> None:
    bench = Bench(tmp_path, mode)
    bench.at(1.0, lambda: bench.replace(9.0, Change("b2", "far")))
    assert bench.run().did[-1] == f"{left} closes"
    assert any("netem cannot do delay_ms" in line for line in bench.log)
    state = told(bench)
    assert state["shaper"] == left
    if mode == "netem":
        assert (state["changes"], state["refused"]) == (0, "b2")
        assert "netem cannot do delay_ms" in str(state["refusal"])


@pytest.mark.parametrize("mode", ["netem", "relay"])
def test_netems_deviations_are_logged_for_each_profile(tmp_path: Path, mode: Mode) -> None:
    first, later = DirectionProfile(corrupt=0.1), DirectionProfile(corrupt=0.2)
    bench = Bench(tmp_path, mode, profile=first)
    bench.at(1.0, lambda: setattr(bench.sidecar, "profile", Loaded(later, {})))
    bench.run()
    said = [line for line in bench.log if "corrupt" in line]
    assert said == (notes(first) + notes(later) if mode == "netem" else [])


def test_a_full_disk_ends_nothing_and_delays_the_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path, "netem")
    full = {"is": False}

    def write(path: Path, text: str) -> None:
        if full["is"]:
            raise OSError(ENOSPC, "No space left on device")
        publish(path, text)

    monkeypatch.setattr(sidecar, "publish", write)
    bench.at(1.0, lambda: full.update({"is": True}))
    bench.at(1.1, lambda: bench.replace(0.5))
    bench.at(2.5, lambda: bench.replace(9.0, Change("b2", "far")))
    bench.at(5.0, lambda: full.update({"is": False}))
    state = told(bench.run(until=7.0))
    assert (state["changes"], state["refused"]) == (1, "b2")
    assert state["profile"] == {"description": "0.5 s"}


def test_it_counts_once_a_second(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay").run(until=5.05)
    at = [at_ns * 1e-9 for at_ns in bench.counted_ns]
    assert at[0] < 0.2
    assert [later - one for one, later in pairwise(at)] == pytest.approx([1.0] * 5, abs=0.1)


RICH = DirectionProfile(
    0.04, 0.01, "table", loss=GilbertElliott(0.01, 0.2), duplicate=0.02, rate=2e6, table=(-1.0, 1.0)
)
OURS: dict[str, Any] = {"kind": "netem", "handle": "7401:", "dev": "eth0", "options": {}}
THEIRS: dict[str, Any] = {"kind": "netem", "handle": "8001:", "dev": "eth0", "options": {}}


@pytest.mark.parametrize(
    "status",
    [
        Told("netem", "link.mode=auto", RICH, Near("eth0", {"eth0": [OURS]})),
        Told("relay", "link.mode=relay", None),
    ],
)
def test_a_status_is_written_and_read_again(status: Told) -> None:
    assert read_told(write_told(status)) == status


@pytest.mark.parametrize("text", ["{}", "no JSON", '{"shaper": "relay", "why": "", "applied": 3}'])
def test_what_is_no_status_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match="Told"):
        read_told(text)


@pytest.mark.parametrize("code", [0, 127])
def test_all_netems_of_a_namespace_are_found(code: int) -> None:
    qdiscs = [{"kind": "noqueue", "dev": "lo"}, OURS, THEIRS, {**THEIRS, "dev": "eth1"}]

    def run(words: Sequence[str]) -> Answer:
        return Answer(code, json.dumps([{"dev": "eth1"}] if words[0] == "ip" else qdiscs), "")

    found = Near("eth1", {"eth0": [OURS, THEIRS], "eth1": [{**THEIRS, "dev": "eth1"}]})
    assert look_near(run, PEER[0]) == (found if code == 0 else None)


def statuses(bench: Bench, *at: float) -> list[Told | None]:
    """Return what a sidecar tells at these times [s]."""
    found: list[Told | None] = []
    for one in at:
        bench.at(one, lambda: found.append(bench.sidecar.told()))
    bench.run(max(at) + 0.5)
    return found


def test_a_sidecar_tells_what_is_in_force(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay", profile=RICH)
    assert bench.sidecar.told() is None
    bench.at(1.0, lambda: bench.replace(0.07))
    assert statuses(bench, 0.5, 1.5) == [
        Told("relay", "link.mode=relay", RICH),
        Told("relay", "link.mode=relay", DirectionProfile(0.07)),
    ]


def test_while_a_time_line_runs_nothing_is_applied(tmp_path: Path) -> None:
    changes = (Step(1.0, delay=0.08, jitter=0.01),)
    profile = DirectionProfile(0.04, changes=changes, blackouts=(Blackout(0.2, 0.1),))
    running, over = statuses(Bench(tmp_path, "relay", profile=profile), 0.5, 1.5)
    assert running is not None
    assert running.applied is None
    assert over is not None
    assert over.applied == DirectionProfile(0.08, 0.01)


def test_a_time_line_that_loops_is_never_over(tmp_path: Path) -> None:
    """Once it counted as over after an hour, with its last row in force."""
    looping = DirectionProfile(trace=Trace((0.0, 1.0), (0.040, 0.050), loop=True))
    (later,) = statuses(Bench(tmp_path, "relay", profile=looping), 3700.0)
    assert later is not None
    assert later.applied is None


def test_tools_are_started_at_most_once_a_second(tmp_path: Path) -> None:
    bench, asked, now = Bench(tmp_path, "relay"), list[str](), [0.0]

    def look(host: str) -> Near:
        asked.append(host)
        return Near("eth0", {})

    source = LinkStatusSource(bench.sidecar, look, lambda: now[0])
    assert source.text() == EMPTY_STATUS
    bench.run(0.5)
    for now[0] in (1.0, 1.5, 1.9, 2.1):
        assert read_told(source.text()).near == Near("eth0", {})
    assert asked == [PEER[0]] * 2
