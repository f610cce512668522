"""A pod records whole flights, and only events between them."""

from __future__ import annotations

from cloudrc.drivers.recording import AFTERWARDS_NS, FlightsOnly
from cloudrc.messages import GuardState
from cloudrc.records import GuardChange, Lateness, Record

PERIOD_NS = 10_000_000


def second(index: int) -> list[Record]:
    """One second of world: a hundred wakes and one guard change."""
    start_ns = index * 1_000_000_000
    wakes = [Lateness(start_ns + n * PERIOD_NS, "world", 0.0, 0.0, 0) for n in range(100)]
    return [*wakes, GuardChange(start_ns + 990_000_000, GuardState.HOLD, "told")]


def test_a_flight_is_recorded_whole_and_the_rest_by_its_events() -> None:
    flying: list[int] = [100, 101, 102]
    now = 0
    choose = FlightsOnly(lambda: now in flying)
    kept = {}
    for now in range(300):
        kept[now] = len(choose(second(now)))
    whole = {index for index, count in kept.items() if count == 101}
    assert whole == set(range(100, 102 + AFTERWARDS_NS // 1_000_000_000 + 1))
    assert {kept[index] for index in kept.keys() - whole} == {1}


def test_nothing_is_chosen_of_nothing() -> None:
    assert FlightsOnly(lambda: True)([]) == []
