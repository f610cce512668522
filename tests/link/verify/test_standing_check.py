"""The standing check in flight: by the tunnel's own datagrams, drawn here without any flight."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from queue import SimpleQueue
from threading import Event

import pytest

from cloudrc.exposition.ends import LinkVerdict
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import STATE_MAX
from cloudrc.link.verify.monitor import Basis, StandingCheck, Tally
from cloudrc.link.verify.twin import WINDOW, Heard, Twin
from cloudrc.records import Arrival, Control, Fault, Lateness, LinkChecked, Record
from tests.link.verify.conftest import (
    DRAWS,
    P1,
    PAPER,
    PERIOD_NS,
    ZERO,
    arrivals,
    checked,
    downlink,
    newest,
)

FAULTS = {
    "mean": replace(PAPER, delay=PAPER.delay * 1.5),
    "deviation": replace(PAPER, jitter=PAPER.jitter * 1.3),
    "loss": replace(PAPER, loss=0.1),
    "reordered": replace(PAPER, keep_order=True, jitter=PAPER.jitter * 0.9),
    "duplicated": replace(PAPER, duplicate=0.2),
}


@pytest.mark.parametrize("quantity", FAULTS)
def test_a_link_that_is_not_what_was_asked_is_a_fault_told_once(quantity: str) -> None:
    records, faults = checked(downlink(PAPER), arrivals(FAULTS[quantity]))
    assert newest(records)[quantity].verdict == "off"
    assert [fault.code for fault in faults] == ["link"]
    assert faults[0].text.startswith("the downlink is not what was asked for: ")


def test_ends_that_wake_late_are_not_the_links_fault() -> None:
    """4 ms more than asked, at an end whose wakes are 2 ms late in the mean, and so the other's."""
    slow = replace(PAPER, delay=PAPER.delay + 0.0045)
    assert checked(downlink(PAPER), arrivals(slow, 100.0))[1], "of punctual ends it is"
    heard: list[Record] = []
    for arrival in arrivals(slow, 100.0):
        heard += [arrival, Lateness(arrival.stamp_ns, "world", 0.002, 0.0002, 0)]
    records, faults = checked(downlink(PAPER), heard)
    assert faults == []
    assert newest(records)["mean"].verdict == "open"


def test_one_long_stall_of_an_end_is_not_the_links_fault() -> None:
    """For half a second nobody reads what has come."""
    stalled: list[Record] = []
    begin_ns, end_ns = 20_000_000_000, 20_500_000_000
    for arrival in arrivals(P1, 32.0):
        late_ns = end_ns - arrival.stamp_ns if begin_ns < arrival.stamp_ns < end_ns else 0
        stamp_ns = arrival.stamp_ns + late_ns
        stalled.append(arrival._replace(stamp_ns=stamp_ns, delay=arrival.delay + late_ns * 1e-9))
        if not late_ns:
            late = 0.5 if 0 < stamp_ns - end_ns < 11_000_000 else 1e-4
            stalled.append(Lateness(stamp_ns, "world", late, 1e-4, 0))
    records, faults = checked(downlink(P1), stalled)
    assert faults == []
    assert newest(records)["deviation"].verdict == "open"


def test_without_a_shared_clock_there_are_no_one_way_delays() -> None:
    records, _ = checked(downlink(PAPER), arrivals(PAPER, overhead=nan))
    assert set(newest(records)) - {"datagrams"} == {"loss", "reordered", "duplicated"}


def control(stamp_ns: int, rtt: float) -> Control:
    return Control(
        stamp_ns, 1, 0, 0, 0.0, rtt, rtt, ZERO, ZERO, (1.0, *ZERO), ZERO, ZERO, 0, ZERO, 0.0,
        ZERO, ZERO, ZERO,
    )  # fmt: skip


@pytest.mark.parametrize(("slower", "verdict"), [(0.0, "ok"), (0.030, "off")])
def test_cloud_judges_round_trips_then(slower: float, verdict: str) -> None:
    """40 ms and 80 ms without jitter: every round trip takes 120 ms."""
    asked = (DirectionProfile(0.040), DirectionProfile(0.080))
    check = StandingCheck(uplink=True, stream=DRAWS._replace(uplink=True))
    check.follow(asked)
    heard: list[Record] = []
    for arrival in arrivals(asked[0], overhead=nan):
        heard.append(arrival._replace(uplink=True))
        heard.append(control(arrival.stamp_ns, 0.121 + slower + arrival.counter * 1e-9))
    records, _ = checked(check, heard)
    trip = newest(records)["round_trip"]
    assert trip.asked == pytest.approx(0.120, abs=1e-4)
    assert trip.verdict == verdict


def test_a_new_profile_is_judged_by_from_then_on() -> None:
    check = downlink(PAPER)
    slow = replace(PAPER, delay=0.120)
    assert checked(check, arrivals(PAPER, 30.0))[1] == []
    check.follow((slow, slow))
    later = [
        arrival._replace(stamp_ns=arrival.stamp_ns + 30_000_000_000, counter=arrival.counter + 3000)
        for arrival in arrivals(slow, 60.0)
    ]
    records, faults = checked(check, later)
    assert faults == []
    assert newest(records)["mean"].asked == pytest.approx(0.120, abs=1e-3)


def test_the_state_file_is_followed_past_invalid_content(tmp_path: Path) -> None:
    seen = Event()
    check, slow = downlink(PAPER), DirectionProfile(0.070)
    follow = check.follow

    def watched(asked: tuple[DirectionProfile, DirectionProfile], shaper: str = "") -> None:
        follow(asked, shaper)
        if asked[1] == slow:
            seen.set()

    check.follow = watched  # type: ignore[method-assign]
    state, path = {"shaper": "relay", "reason": "", "mode": "relay"}, tmp_path / "link.json"
    state |= {"direction": "uplink", "since": "", "since_ns": 0}  # type: ignore[dict-item]
    path.write_text(json.dumps(state | {"profile": "nonsense"}))

    def load(values: object) -> tuple[DirectionProfile, DirectionProfile]:
        if values == "nonsense":
            path.write_text(json.dumps(state | {"profile": {"downlink": {"delay_ms": 70}}}))
            raise OverflowError
        return DirectionProfile(), slow

    check.begin((PAPER, PAPER), path, load)
    assert seen.wait(20.0)
    records, _ = checked(check, arrivals(slow))
    assert newest(records)["mean"].asked == pytest.approx(0.070)


def test_a_state_file_that_would_block_the_loop_is_not_loaded(tmp_path: Path) -> None:
    check, path, loaded, done = downlink(PAPER), tmp_path / "link.json", list[object](), Event()
    check.follow = lambda *given: None  # type: ignore[method-assign]
    names = ("shaper", "reason", "mode", "direction", "since", "since_ns")

    def state(profile: str, reason: str = "") -> str:
        return json.dumps(dict.fromkeys(names, "") | {"profile": profile, "reason": reason})

    def load(values: object) -> tuple[DirectionProfile, DirectionProfile]:
        loaded.append(values)
        done.set()
        return PAPER, PAPER

    path.write_text(state("long", "x" * STATE_MAX))
    check.begin((PAPER, PAPER), path, load)
    assert check._jobs is not None
    check._jobs.put(lambda: path.write_text(state("short")))  # after the first look
    assert done.wait(20.0)
    assert loaded == ["short"]


def test_nothing_is_judged_after_a_state_file_that_is_too_long(tmp_path: Path) -> None:
    check, path, done = downlink(PAPER), tmp_path / "link.json", Event()
    path.write_text("x" * (STATE_MAX + 1))
    check.begin((PAPER, PAPER), path, lambda values: (PAPER, PAPER))
    assert check._jobs is not None
    check._jobs.put(done.set)  # after the first look
    assert done.wait(20.0)
    assert checked(check, arrivals(FAULTS["mean"])) == ([], [])


def test_a_new_session_begins_anew() -> None:
    tally = Tally()
    assert tally.see(Arrival(0, False, 1, 500, 0.05, True)), "what was before is not judged"
    assert not tally.see(Arrival(0, False, 1, 503, 0.05, True))
    assert tally.block.arrived == 1
    assert not tally.see(Arrival(0, False, 1, 502, 0.07, True))
    assert (tally.block.late, tally.block.pairs) == (1, 1)
    assert tally.block.steps == pytest.approx(0.02)
    assert not tally.see(Arrival(0, False, 1, 502, 0.07, True))
    assert (tally.block.copies, tally.block.arrived) == (1, 2)
    for counter in range(504, 700):
        tally.see(Arrival(0, False, 1, counter, 0.05, True))
    block = tally.take()
    assert (block.sent, block.lost) == (700 - 500 - 128, 1), "501 can still arrive until then"
    assert tally.see(Arrival(0, False, 2, 0, 0.05, True))


@pytest.mark.parametrize(
    ("gap", "compared"),
    [(20_000, 24_000 - WINDOW), (10**6, 2000 - WINDOW), (10**18, 2000 - WINDOW)],
)
def test_datagrams_after_a_gap_of_hours_are_not_compared(gap: int, compared: int) -> None:
    """Of minutes, though, all that should have come; a hostile counter may jump by anything."""
    heard = [(n * PERIOD_NS, n + gap * (n >= 2000), 0.0705) for n in range(4000)]
    found = Twin(DirectionProfile(0.070), DRAWS).compare(1, heard)
    assert found is not None
    assert (len(found.pairs.sent), int(found.pairs.arrived.sum())) == (
        compared,
        min(compared, 4000 - WINDOW),
    )


def test_a_failed_comparison_is_logged_once_and_checks_go_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    followed, made = Event(), SimpleQueue[int]()

    def fails(self: Basis, epoch: int, heard: Sequence[Heard]) -> None:
        made.put(epoch)
        raise MemoryError("no\nroom")

    monkeypatch.setattr(Basis, "compare", fails)
    check = StandingCheck(uplink=False, stream=DRAWS)
    steady = DirectionProfile(0.070)
    monkeypatch.setattr(
        check, "follow", lambda *asked: (StandingCheck.follow(check, *asked), followed.set())
    )
    check.begin((steady, steady), None, lambda values: (steady, steady))
    assert followed.wait(20.0)
    flight, faults = arrivals(steady, 90.0), list[Fault]()
    for third in (flight[:3000], flight[3000:6000], flight[6000:]):
        faults += checked(check, third)[1]
        assert made.get(timeout=20.0) == 1
    text = "the standing check of the link failed (MemoryError: no room); it goes on"
    assert [(fault.code, fault.text) for fault in faults] == [("link_check", text)]


def test_what_is_exposed_is_the_newest_verdict() -> None:
    check = LinkVerdict("uplink")
    assert check.read() == {}
    check.see(LinkChecked(1, True, "mean", 0.04, nan, 0.03, 0.05, "open", 100))
    assert check.read() == {}
    for verdict in ("ok", "off"):
        check.see(LinkChecked(2, True, verdict, 0.04, 0.09, 0.03, 0.05, verdict, 900))
    assert check.read() == {"cloudrc_link_believed": {("uplink",): 0.0}}
    found = json.loads(check.text())
    assert (found["verdict"], len(found["rows"]), found["rows"][0]["datagrams"]) == ("off", 2, 900)
