"""Faults F23 and F25: a cloud sends impossible values; two clouds want the same robot."""

from __future__ import annotations

from math import inf, nan

from cloudrc.faults import measures
from cloudrc.faults.adversary import Lie
from cloudrc.faults.flight import Flight
from cloudrc.faults.models import EndpointGroup
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.messages import Command, GuardState
from cloudrc.records import Control, Fault
from cloudrc.tunnel.handshake import BUSY_TEXT
from cloudrc.world.endpoint import WorldEndpoint

LIES: dict[str, Lie] = {
    "NaN": lambda command, control: command._replace(velocity=(nan, 0.0, 0.0)),
    "yaw infinite": lambda command, control: command._replace(yaw_rate=inf),
    "1e308": lambda command, control: command._replace(velocity=(1e308, -1e308, 1e308)),
}
CLAMPED: dict[str, Lie] = {
    "speed": lambda command, control: command._replace(velocity=(100.0, 0.0, 0.0)),
    "yaw_rate": lambda command, control: command._replace(yaw_rate=100.0),
}
"""Commands of 100 m/s and 100 rad/s, by the limit of the guard that they meet."""


def _between(first: float, last: float, lie: Lie) -> Lie:
    def lying(command: Command, control: Control) -> Command:
        now = control.stamp_ns * 1e-9
        return lie(command, control) if first <= now < last else command

    return lying


def _liar(seed: int) -> Outcome:
    outcome, at = Outcome(), measures.instant(seed)
    for name, lie in LIES.items():
        flight = _lied_to(seed, _between(at, at + 1.0, lie))
        measures.safe(outcome, flight)
        lands = measures.changes_into(flight, GuardState.LAND)
        labels = ("downlink", "range")
        measures.moves(outcome, flight, "world", "datagrams_total", *labels, since=at)
        outcome.most(f"{name}: LAND after", (lands or [nan])[0] - at, 1.0, "s")
        again = [
            t for t in measures.changes_into(flight, GuardState.TRACK) if t > (lands or [0.0])[0]
        ]
        outcome.same(f"{name}: flown again without the operator", len(again), 0)
        causes = " ".join(c.cause for c in flight.changes if c.state is GuardState.LAND)
        outcome.true(f"{name}: the cause is told", "impossible commands" in causes)
    for limit, lie in CLAMPED.items():
        flight = _lied_to(seed, _between(at, at + 1.0, lie), harmless=limit != "speed")
        measures.safe(outcome, flight)
        refused = sum("impossible" in change.cause for change in flight.changes)
        outcome.same(f"100 times {limit}: taken for impossible", refused, 0)
        outcome.least(f"100 times {limit}: clamped", flight.count(f"limited_{limit}"), 20)
        measures.moves(outcome, flight, "world", "guard_limited_total", limit, since=at)
    one = _lied_to(seed, _between(at, at + 0.005, LIES["NaN"]))
    measures.safe(outcome, one)
    outcome.same("a single NaN: LAND", len(measures.changes_into(one, GuardState.LAND)), 0)
    measures.done(outcome, one)
    return outcome


def _lied_to(seed: int, lie: Lie, harmless: bool = True) -> Flight:
    """Fly with a lie; unless it is harmless, the robot may hit a pipe."""
    return Flight(seed=seed, honest=harmless, lies=[lie]).fly(40.0)


def _two_clouds(seed: int) -> Outcome:
    outcome, at = Outcome(), measures.instant(seed, 4.0, 12.0)
    flight = Flight(seed=seed, second=at)
    group = flight.cloud.inner
    assert isinstance(group, EndpointGroup)
    opened: list[int] = []
    flight.world.at(at + 5.0, lambda _: opened.extend(measures.epochs(flight)))

    def leave(now_ns: int) -> None:
        group.members = group.members[1:]

    flight.cloud.at(at + 6.0, leave)
    flight.fly(at + 14.0)
    measures.safe(outcome, flight)
    outcome.same("epochs while both are there", max(opened, default=-1), 2)
    held = measures.changes_into(flight, GuardState.HOLD, at + 6.0)
    outcome.same("HOLDs while both are there", len(held), 0)
    measures.moves(outcome, flight, "world", "datagrams_total", "downlink", "busy", since=at)
    measures.moves(outcome, flight, "world", "sessions_refused_total", since=at)
    assert isinstance(flight.world.inner, WorldEndpoint)
    outcome.least("the second is refused", flight.world.inner.counts["busy"], 1)
    told = [r for r in group.others if isinstance(r, Fault) and r.code == "busy"]
    outcome.true("the second says why it waits, once", [r.text for r in told] == [BUSY_TEXT])
    said = min((r.stamp_ns * 1e-9 for r in told), default=nan)
    outcome.most("it says so after", said - at, 1.0, "s")
    by_first = [r for r in measures.seen_by(flight, "cloud", at + 6.0) if isinstance(r, Fault)]
    outcome.same("faults that the first tells of", len(by_first), 0)
    measures.held_in_time(outcome, flight, "HOLD once the first is gone")
    later = [epoch for epoch in measures.epochs(flight) if epoch > 2]
    outcome.true("then the second gets a higher epoch", bool(later))
    outcome.true("commands applied in order, none twice", measures.applied_in_order(flight))
    return outcome


SCENARIOS = (
    Scenario(
        23,
        "invalid-values",
        "NaN, infinite, huge and over-limit values with a valid seal",
        "refused or clamped; 5 refused in 1 s: LAND, latched",
        "those commands",
        "guard LAND with its cause, cloudrc_datagrams_total{outcome=range}, "
        "cloudrc_guard_limited_total",
        _liar,
    ),
    Scenario(
        25,
        "two-clouds",
        "a second cloud with the same key; later the first one leaves",
        "the first keeps authority while fresh; after HOLD the second gets a higher epoch; "
        "commands never interleave",
        "none",
        "fault 'busy' in the second: another cloud controls the robot; "
        "cloudrc_datagrams_total{outcome=busy}, cloudrc_sessions_refused_total",
        _two_clouds,
    ),
)
