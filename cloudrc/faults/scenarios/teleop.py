"""Faults around the operator: floods, impossible and rival missions, slow readers, shutdown."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator
from math import nan
from pathlib import Path
from typing import Any

from cloudrc import assembly
from cloudrc.drivers.teleop import LastWord
from cloudrc.faults import asks, toll
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.faults.scenarios.link import instant
from cloudrc.messages import GuardState
from cloudrc.teleop.bridge import Bridge
from cloudrc.teleop.store import LOGGED, Event, Order, UnavailableError

PER_PERIOD = 10
"""Requests in every 10 ms: 1,000 in a second."""
AWAY = 6.0
"""How long there is no pod [s]: longer than a metric may take to show that its mission is held."""
WAKE = 0.01
"""Between two wakes of cloud, at which it is asked whether it ends [s]."""


def _flood(seed: int) -> Outcome:
    """Through the API's bridge, as its threads do; the loop of cloud is another process."""
    outcome, bridge, answers = Outcome(), Bridge(), [0, 0]
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)
    service = flight.desk.service
    assert service is not None
    bridge.open(service)

    def ask(now_ns: int) -> None:
        for _ in range(PER_PERIOD * 10):
            try:
                bridge.submit(lambda service, now_ns: service.state(now_ns))
                answers[0] += 1
            except UnavailableError:
                answers[1] += 1
        for call in bridge.take():
            call(now_ns)

    for n in range(10, 300):
        flight.cloud.at(n * 0.1, ask)
    flight.fly_mission()
    asks.safe(outcome, flight)
    outcome.true("the same path, bit by bit", asks.same_path(clean, flight))
    outcome.least("requests answered", answers[0], 1000)
    outcome.least("requests refused as too many", answers[1], 1000)
    refused = _at_the_gate(1000)
    meters.counts(outcome, "teleop", "api_busy", refused, "api_rejected_total", "busy")
    return outcome


def _at_the_gate(count: int) -> int:
    """Have so many requests come at once to the API's gate; say how many it calls too many."""

    class Waits:
        """An answer that never comes."""

        def __await__(self) -> Generator[None, None, None]:
            while True:
                yield

    async def application(scope: Any, receive: Any, send: Any) -> None:
        await Waits()

    return toll.counted(application, "GET", "/v1/state", count)["busy"]


def _slow_reader(seed: int) -> Outcome:
    outcome = Outcome()
    flight = Flight(seed=seed).fly_mission()
    service = flight.desk.service
    assert service is not None
    newest = service.book.events_after(0)[-1]["id"]
    plan = assembly.build_plan(flight.experiment)
    followed = [newest]
    for n in range(LOGGED):
        service.create(Order(plan, f"{n}"), n)
        service.cancel(service.book.open()[0].id, n)
        followed += [event["id"] for event in service.book.events_after(followed[-1])]
    outcome.same("events dropped for a reader that reads", service.book.dropped, 0)
    outcome.true("its events have no gap, though another one does not read", _gapless(followed))
    outcome.least("it has all of them", len(followed) - 1, 2 * LOGGED)
    waiting = service.book.events_after(newest)
    outcome.most("events kept for a reader that does not read", len(waiting), LOGGED)
    dropped = service.book.dropped
    meters.counts(outcome, "teleop", "api_events_dropped", dropped, "stream_dropped_events_total")
    outcome.true("the newest are kept", waiting[-1]["id"] > newest + LOGGED)
    outcome.true("those kept have no gap", _gapless([event["id"] for event in waiting]))
    asks.safe(outcome, flight)
    return outcome


def _gapless(numbers: list[int]) -> bool:
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def _shutdown(seed: int) -> Outcome:
    """SIGTERM of the cloud pod: teleop and cloud, each a process, are asked at once."""
    outcome, at, left = Outcome(), instant(seed, 6.0, 20.0), list[Event]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "missions"
        flight = Flight(seed=seed, journal=path, apart=True)

        def gone(now_ns: int) -> None:
            flight.kill_cloud_pod(now_ns, AWAY)
            left.extend(flight.desk.entries)

        ended = _shut_down(flight, at, gone)
        flight.fly_mission()
        asks.safe(outcome, flight)
        outcome.most("cloud ends after", min(ended, default=nan) - at, 2.0, "s")
        changes = [c for c in flight.changes if c.stamp_ns * 1e-9 > at]
        held = next((c for c in changes if c.state is GuardState.HOLD), None)
        after = held.stamp_ns * 1e-9 - at if held is not None else nan
        outcome.most("HOLD after", after, 0.5, "s")
        outcome.true("by a word, not for want of it", held is not None and held.cause == asks.ENDED)
        told = [str(entry.get("text", "")) for entry in left if entry.get("event") == "paused"]
        outcome.same("entries of it that the pod has left in its journal", len(told), 1)
        said = all(text.startswith("paused by shutdown") for text in told)
        outcome.true("they say: paused by shutdown", bool(told) and said)
        meters.moves(outcome, flight, "teleop", "mission_state", since=at)
        outcome.true("the new pod finishes the mission", flight.mission.state == "done")
        outcome.true("each waypoint reached once, in order", asks.waypoints_in_order(flight))
        flight.desk.kill()
    return outcome


def _shut_down(flight: Flight, at: float, gone: Callable[[int], None]) -> list[float]:
    """SIGTERM of both processes at an instant [s]; cloud ends as production lets it.

    Args:
        flight: Whose.
        at: When [s].
        gone: Called at the instant [ns] at which cloud has ended.

    Returns:
        Gets that instant [s].
    """
    cloud, ended = flight.cloud, list[float]()

    def flies() -> bool:
        return getattr(cloud.inner, "guard", None) is GuardState.TRACK

    ends = LastWord(lambda: True, flies, lambda: flight.run.now_ns)

    def ask(now_ns: int) -> None:
        flight.desk.shut_down(now_ns)
        look(now_ns)

    def look(now_ns: int) -> None:
        if ends():
            ended.append(now_ns * 1e-9)
            gone(now_ns)
        else:
            cloud.at(now_ns * 1e-9 + WAKE, look)

    cloud.at(at, ask)
    return ended


SCENARIOS = (
    Scenario(
        26,
        "api-flood",
        "1,000 requests a second at the API's bridge",
        "none: the same path, bit by bit (how the control period fares beside it and beside slow "
        "clients, in real time: tests/drivers/test_teleop_flood.py)",
        "requests beyond what is taken: refused as too many",
        "cloudrc_api_rejected_total",
        _flood,
    ),
    Scenario(
        32,
        "slow-reader",
        "a reader of the event stream does not read for 5,000 events",
        "the oldest are dropped for that reader alone; memory stays bounded (by a number and not "
        "by 1 s: who was away for a minute is to miss none)",
        "its events",
        "a gap in the numbers of its events; cloudrc_stream_dropped_events_total",
        _slow_reader,
    ),
    Scenario(
        33,
        "shutdown",
        "SIGTERM of cloud and teleop at once in a mission, new ones 6 s later",
        "both end in 2 s, HOLD in 0.5 s by their word; the journal is written; the new pod goes on",
        "none",
        "paused by shutdown, cloudrc_mission_state",
        _shutdown,
    ),
)
