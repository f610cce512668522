"""Which state the search takes the guard for: that of the world that lives, before a contact."""

from __future__ import annotations

import pytest

from cloudrc.faults import fuzz
from cloudrc.faults.flight import Flight, seen_now, state_at, state_before
from cloudrc.faults.fuzz import fly
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.records import Contact, GuardChange

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
MS = 1_000_000


def change(at_ms: int, state: GuardState, cause: Cause = Cause.COMMAND) -> GuardChange:
    return GuardChange(at_ms * MS, state, cause.words)


@pytest.mark.parametrize("kind", ["world_killed", "wall_clock"])
def test_an_unreachable_robot_is_stuck_also_in_a_new_world(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new world that hears nothing changes nothing; its forerunner was in TRACK."""
    inject = fuzz.inject

    def deaf(flight: Flight, *rest: object) -> None:
        inject(flight, *rest)  # type: ignore[arg-type]
        flight.world.at(5.05, lambda _: setattr(flight.world, "tamper", lambda *_: []))

    monkeypatch.setattr(fuzz, "inject", deaf)
    finding = fly(Schedule(3, "paper-p1", (Event(kind, 5.0, 0.02, 1.0),), duration=20.0))
    assert finding.kinds == {"stuck"}
    told = "GROUND (at its spawn)" if kind == "world_killed" else "HOLD (no fresh commands)"
    assert told in finding.breaches[0].text


def test_a_killed_world_and_its_successor_are_on_the_ground() -> None:
    flight = Flight().fly(2.0)
    assert seen_now(flight.world.inner) == (TRACK, "fresh command")
    flight.kill_world(flight.run.now_ns, 0.5)
    assert seen_now(flight.world.inner)[0] is GROUND
    flight.fly(2.55)
    assert seen_now(flight.world.inner) == (GROUND, "at its spawn")
    assert flight.state_at(flight.run.now_ns) is GROUND
    assert flight.state_at(1_900 * MS) is TRACK


def test_the_state_at_an_instant_is_that_of_the_world_of_then() -> None:
    changes = [change(10, TRACK), change(50, HOLD), change(300, TRACK)]
    ends = {5: GROUND, 10: TRACK, 60: HOLD, 199: HOLD, 200: GROUND, 299: GROUND, 300: TRACK}
    for at_ms, state in ends.items():
        assert state_at(changes, at_ms * MS, 200 * MS) is state
        assert state_before(changes, at_ms * MS, 200 * MS) is state


@pytest.mark.parametrize(
    ("stopped_ms", "cause", "state"),
    [
        (2004, Cause.JOLTED, TRACK),
        (2001, Cause.OVERTURNED, TRACK),
        (2000, Cause.JOLTED, ESTOP),
        (2004, Cause.STOPPED, ESTOP),
    ],
)
def test_what_a_contact_has_stopped_flew_when_it_began(
    stopped_ms: int, cause: Cause, state: GuardState
) -> None:
    changes = [change(0, TRACK), change(stopped_ms, ESTOP, cause)]
    assert state_before(changes, 2010 * MS, 0) is state


def test_an_early_acknowledgement_does_not_undo_a_landing() -> None:
    for held_ms, state in ((1900, LAND), (1800, HOLD)):
        changes = [change(0, LAND), change(held_ms, HOLD, Cause.NOT_DOWN)]
        assert state_before(changes, 2010 * MS, 0) is state


def test_a_crash_onto_the_floor_is_a_collision() -> None:
    for flown, kinds in ((TRACK, {"collision"}), (HOLD, {"collision"}), (LAND, set())):
        flight = Flight(start=False)
        contact = Contact(2010 * MS, "floor", ZERO, (0.0, 0.0, -3.0), ZERO, False)
        flight._note([change(0, flown), change(2004, ESTOP, Cause.JOLTED), contact])
        assert set(flight.watch.counts) == kinds
