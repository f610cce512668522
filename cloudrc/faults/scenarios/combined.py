"""Fault F40: the link, both ends and teleop freeze one by one, and return in random order."""

from __future__ import annotations

from functools import partial

import numpy as np

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, blackouts
from cloudrc.faults.scenario import Outcome, Scenario, generator

THINGS = ("uplink", "downlink", "cloud", "world", "teleop")
"""Order in which the things freeze: a direction before its sender, so that datagrams are lost."""


def _spans(seed: int) -> dict[str, tuple[float, float]]:
    """Choose when each thing freezes, and for how long [s]; they return in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    rng, count = generator(seed, 40), len(THINGS)
    starts = measures.instant(seed) + np.cumsum(rng.uniform(0.1, 1.0, count))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.1, 1.5, count)))
    spans = [(float(a), float(b - a)) for a, b in zip(starts, ends, strict=True)]
    return dict(zip(THINGS, spans, strict=True))


def _swizzle(seed: int) -> Outcome:
    outcome, spans = Outcome(), _spans(seed)
    flight = Flight(
        "criteria.time_limit_s=120",
        seed=seed,
        uplink=blackouts(spans["uplink"]),
        downlink=blackouts(spans["downlink"]),
    )
    for name, end in (("cloud", flight.cloud), ("world", flight.world)):
        start, duration = spans[name]
        end.at(start, partial(end.freeze, duration=duration))
    start, duration = spans["teleop"]
    flight.cloud.at(start, lambda _: flight.teleop.kill())
    flight.cloud.at(start + duration, lambda _: flight.teleop.start())
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    measures.held_in_time(outcome, flight)
    _chain(outcome, flight, spans)
    return outcome


def _chain(outcome: Outcome, flight: Flight, spans: dict[str, tuple[float, float]]) -> None:
    """Check that the guard tells why it held, and that each thing tells that it was frozen."""
    measures.causes_told(outcome, flight)
    since, over = spans[THINGS[0]][0], max(sum(span) for span in spans.values())
    for role, *metric in (
        ("cloud", "datagrams_lost_total", "uplink"),
        ("world", "datagrams_lost_total", "downlink"),
        ("cloud", "loop_missed_periods_total"),
        ("world", "world_slip_seconds_total"),
        ("world", "guard_transitions_total", "hold"),
    ):
        measures.moves(outcome, flight, role, *metric, since=since, over=over)
    for end, records in (("cloud", flight.of_cloud), ("world", flight.of_world)):
        outcome.least(f"times that {end} tells: late", len(measures.told(records, "late")), 1)
    restarted = measures.events_of_missions(flight, "restarted")
    outcome.least("the log tells: restarted", len(restarted), 1)


SCENARIOS = (
    Scenario(
        40,
        "swizzle-clog",
        "uplink, downlink, cloud, world and teleop freeze one by one and return in random order",
        "always a safe state; the mission goes on",
        "as above",
        "guard HOLD with its cause, cloudrc_guard_transitions_total; of each that was frozen: "
        "fault 'late' of both ends, "
        "cloudrc_datagrams_lost_total both ways, cloudrc_loop_missed_periods_total, "
        "cloudrc_world_slip_seconds_total, mission restarted",
        _swizzle,
    ),
)
