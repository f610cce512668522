"""Ends that share no clock: round trips alone tell of delays, and a verdict comes all the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from math import isfinite, nan

import pytest

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.exposition.ends import LinkVerdict
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify.monitor import StandingCheck
from cloudrc.link.verify.standing import TICK, WINDOW_MAX
from cloudrc.link.verify.twin import Stream
from cloudrc.records import Arrival, Control, Lateness, LinkChecked, Record
from cloudrc.world.scene import TIMESTEP
from tests.conftest import nightly
from tests.link.verify.conftest import (
    TELEMETRY,
    TELEMETRY_SIZE,
    ZERO,
    arrivals,
    believed,
    checked,
    moments,
    newest,
)

PERIOD_NS, TICK_NS = 10_000_000, round(TICK * 1e9)
HELM_TEST = 268.0
"""So long a flight is judged before `helm test` gives up, but for its settling [s]."""
NAMES = ("paper-p1", "satellite", *nightly("ideal", "5g", "wifi", "lte"))


def ways(name: str) -> tuple[DirectionProfile, DirectionProfile]:
    profile = load_profile(name)
    return link_profile(profile.uplink), link_profile(profile.downlink)


def control(stamp_ns: int, rtt: float) -> Control:
    return Control(
        stamp_ns, 1, 0, 0, 0.0, rtt, rtt, ZERO, ZERO, (1.0, *ZERO), ZERO, ZERO, 0, ZERO, 0.0,
        ZERO, ZERO, ZERO,
    )  # fmt: skip


def flight(
    up: DirectionProfile,
    down: DirectionProfile,
    seconds: float = HELM_TEST,
    *,
    seed: int = 2,
    netem: bool = False,
    late: float | None = 5e-5,
    adds: float = 2e-4,
    phase_ns: int = 3_300_000,
) -> list[Record]:
    """What cloud notes: arrivals without delays, round trips, and how late it wakes.

    World applies a command with its next tick; cloud notes the newest round trip once a period.

    Args:
        up: The uplink.
        down: The downlink.
        seconds: How long [s].
        seed: Of their chance.
        netem: Whether netem shapes.
        late: Of each wake [s]; None: nobody tells.
        adds: What both ends add to a round trip [s].
        phase_ns: When a period of cloud's begins, in one of world's [ns].
    """
    there = arrivals(up, seconds, seed=seed, overhead=0.0, uplink=True, netem=netem)
    back = arrivals(down, seconds, seed=seed + 100, overhead=0.0, netem=netem)
    echoed = echoes(back, round(seconds * 100), phase_ns)
    heard, seen, last, tick_ns, trip = list[Record](), -1, -1, phase_ns, nan
    for one in there:
        while tick_ns < one.stamp_ns:
            heard.append(control(tick_ns, trip))
            if late is not None:
                heard.append(Lateness(tick_ns, "cloud", late, 5e-5, 0))
            tick_ns += PERIOD_NS
        heard.append(one._replace(delay=nan))
        if one.counter > seen:
            seen = one.counter
            command, delay = echoed[seen]
            if command > last:
                last = command
                # Of two that are equal, which has no jitter, the second is no new echo.
                trip = one.delay + delay + adds + one.counter * 1e-12
    return heard


def echoes(back: list[Arrival], count: int, phase_ns: int) -> list[tuple[int, float]]:
    """Say for each telemetry which command was the newest when it left, and when that applied."""
    found, place, newest_one = list[tuple[int, float]](), 0, (-1, 0.0)
    applied = [-(-(one.stamp_ns + phase_ns) // TICK_NS) * TICK_NS for one in back]
    for n in range(count):
        while place < len(back) and applied[place] <= n * PERIOD_NS:
            counter = back[place].counter
            since_ns = applied[place] - counter * PERIOD_NS - phase_ns
            newest_one = max(newest_one, (counter, since_ns * 1e-9))
            place += 1
        found.append(newest_one)
    return found


def cloud(up: DirectionProfile, down: DirectionProfile, *, netem: bool = False) -> StandingCheck:
    check = StandingCheck(uplink=True, stream=Stream(1, True, TELEMETRY, TELEMETRY_SIZE))
    check.follow((up, down), "netem" if netem else "relay")
    return check


def sane(records: list[LinkChecked]) -> bool:
    """No number of datagrams that nobody would wait for, unless it is said to be none."""
    told = [one.asked for one in records if one.quantity.endswith(("_takes", "datagrams"))]
    return all(one < 1e6 for one in told if isfinite(one))


@pytest.mark.parametrize("netem", [False, True], ids=["relay", "netem"])
@pytest.mark.parametrize("name", NAMES)
def test_without_a_shared_clock_there_is_a_verdict(name: str, netem: bool) -> None:
    up, down = ways(name)
    records, faults = checked(
        cloud(up, down, netem=netem), flight(up, down, seed=2 if netem else 1, netem=netem)
    )
    assert faults == []
    assert believed(records), newest(records)
    # Without jitter, world's ticks hide as much as a light link may be off.
    judged = "told" if name in ("ideal", "paper-p1") else "ok"
    assert newest(records)["round_trip"].verdict == judged
    assert sane(records)


def test_the_ticks_are_those_of_worlds_simulation() -> None:
    assert TICK == TIMESTEP


OFF: dict[str, Callable[[DirectionProfile], DirectionProfile]] = {
    "2 ms slower": lambda one: replace(one, delay=one.delay + 2e-3),
    "2 ms quicker": lambda one: replace(one, delay=max(0.0, one.delay - 2e-3)),
}


@pytest.mark.parametrize("seed", [3, *nightly(4, 5)])
@pytest.mark.parametrize("adds", [0.0, 4e-4])
@pytest.mark.parametrize("fault", OFF)
def test_round_trips_off_by_their_margin_are_not_believed(
    fault: str, adds: float, seed: int
) -> None:
    up, down = ways("5g")
    real, phase_ns = OFF[fault](up), 1_900_000 * seed
    heard = flight(real, down, 150.0, seed=seed, adds=adds, phase_ns=phase_ns)
    records, _ = checked(cloud(up, down), heard)
    assert not [one for one in moments(records) if believed(one)]
    assert newest(records)["round_trip"].verdict in ("off", "open"), "ends may have been late"


@pytest.mark.parametrize(("late", "ever"), [(None, False), (1.5e-3, False), (1e-5, True)])
def test_errors_hidden_by_late_ends_are_not_judged(late: float | None, ever: bool) -> None:
    up, down = ways("paper-p1")
    records, faults = checked(cloud(up, down), flight(up, down, 100.0, late=late))
    last = newest(records)
    assert faults == []
    assert believed(records), last
    assert last["round_trip"].verdict == "told"
    assert last["round_trip"].measured == pytest.approx(0.037, abs=2e-3)
    assert isfinite(last["round_trip_takes"].asked) == ever
    assert last["round_trip_takes"].asked > WINDOW_MAX
    assert last["datagrams"].asked < WINDOW_MAX
    assert sane(records)
    check = LinkVerdict("uplink")
    for record in records:
        check.see(record)
    assert json.loads(check.text())["verdict"] == "ok"


def test_round_trips_far_off_are_reported_without_proof() -> None:
    up, down = ways("paper-p1")
    real = replace(up, delay=up.delay + 0.010)
    _, faults = checked(cloud(up, down), flight(real, down, 60.0, late=None))
    assert [fault.code for fault in faults] == ["link"]


def test_where_delays_are_known_round_trips_are_not_waited_for() -> None:
    up, down = ways("paper-p1")
    check = cloud(up, down)
    records, faults = checked(check, arrivals(up, 60.0, seed=2, uplink=True))
    assert faults == []
    assert believed(records)
    assert "round_trip" not in newest(records)
    assert newest(records)["datagrams"].asked < 6000
