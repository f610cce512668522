"""A random schedule: a seed goes in, faults of every kind for one minute come out."""

from __future__ import annotations

import numpy as np

from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import KINDS, WALL_MAX, WAYS, Event, Schedule

CALM = 45.0
"""From here on nothing new happens: the robot has to find back [s]."""
DURATION = 60.0
"""Of a flight [s]."""
PROFILES = ("ideal", "wifi", "lte", "5g", "lossy", "paper-p1", "paper-p2", "paper-p3")
PAPER = PROFILES[-3:]
HOLDS = 0.8, 3.0
"""Shortest and longest HOLD that is drawn [s]: 0.75 s are needed to fly on, at the default age."""
HOLD_MAX = Schedule(0).hold_max
ONCE = ("second_cloud", "key_rotated")
"""Kinds that happen at most once in a flight."""

# Kind -> longest duration [s], lowest and highest value.
RANGES: dict[str, tuple[float, float, float]] = {
    "blackout": (8.0, 0.0, 0.0),
    "delay": (10.0, 0.01, 0.3),
    "jitter": (10.0, 0.01, 0.15),
    "loss": (10.0, 0.05, 0.9),
    "bursts": (15.0, 3.0, 60.0),
    "corruption": (10.0, 0.01, 1.0),
    "garbage": (5.0, 1.0, 20.0),
    "replay": (5.0, 1.0, 20.0),
    "cloud_killed": (5.0, 0.0, 0.0),
    "pod_killed": (8.0, 0.0, 0.0),
    "teleop_killed": (6.0, 0.0, 0.0),
    "teleop_shut_down": (6.0, 0.0, 1.0),
    "pod_shut_down": (8.0, 0.0, 1.0),
    "cloud_paused": (5.0, 0.0, 0.0),
    "cloud_throttled": (8.0, 0.05, 0.9),
    "world_paused": (1.0, 0.0, 0.0),
    "world_killed": (3.0, 0.0, 0.0),
    "world_throttled": (8.0, 0.1, 0.95),
    "wall_clock": (0.0, -WALL_MAX, WALL_MAX),
    "journal_full": (10.0, 0.0, 0.0),
    "journal_slow": (10.0, 0.05, 3.0),
    "teleop_paused": (5.0, 0.0, 0.0),
    "journal_torn": (8.0, 1.0, 60.0),
    "journal_rotten": (8.0, 0.0, 1.0),
    "api_flood": (5.0, 10.0, 64.0),
    "recorder_full": (10.0, 0.0, 60_000.0),  # 14 kB at once, 33 kB/s then: two in three are full
    "recorder_slow": (10.0, 0.1, 5.0),
    "recorder_killed": (10.0, 0.0, 0.0),
    "power_cut": (10.0, 0.0, 0.0),
    "names_lost": (10.0, 0.0, 1.0),
    "second_cloud": (15.0, 0.0, 0.0),
    "key_rotated": (10.0, 0.0, 0.0),
    "key_wrong": (10.0, 0.001, 3.0),
    "values_invalid": (10.0, 1.0, 12.0),
    "values_huge": (10.0, 1.0, 4.0),
    "second_order": (0.0, 0.0, 0.0),
    "stopped": (0.0, 0.0, 0.0),
    "held": (5.0, 0.0, 0.0),
}


def compose(seed: int) -> Schedule:
    """Make the schedule of a seed: 1 to 12 faults within 45 s, then 15 s of calm."""
    rng = generator(seed, 40)
    events: list[Event] = []
    kinds = sorted(KINDS)
    for _ in range(int(rng.integers(1, 13))):
        kind = kinds[int(rng.integers(len(kinds)))]
        if kind not in ONCE or all(event.kind != kind for event in events):
            events.append(_event(kind, rng))
    if rng.random() < 0.3:
        events += _swizzle(rng)
    return Schedule(
        seed,
        PROFILES[int(rng.integers(len(PROFILES)))],
        tuple(sorted(events, key=lambda event: event.at)),
        duplicate=_sometimes(rng, 1.0),
        reorder=_sometimes(rng, 0.5),
        cloud_offset=round(float(rng.uniform(-1e5, 1e5)), 3) if rng.random() < 0.5 else 0.0,
        cloud_drift=int(rng.integers(-500, 501)) if rng.random() < 0.3 else 0,
        duration=DURATION,
        apart=bool(rng.random() < 0.5),
        # In every third schedule shorter than many a silence: the robot lands amid other faults.
        hold_max=round(float(rng.uniform(*HOLDS)), 1) if rng.random() < 1 / 3 else HOLD_MAX,
    )


def calm(seed: int) -> Schedule:
    """Make a flight in which nothing goes wrong, on one of the paper's three links."""
    return Schedule(seed, PAPER[seed % len(PAPER)], duration=DURATION)


def _event(kind: str, rng: np.random.Generator) -> Event:
    longest, low, high = RANGES[kind]
    at = float(rng.uniform(0.5, CALM - 1.0))
    # As many short ones as long ones: 20 ms are as good at finding something as 5 s.
    duration = longest * float(rng.uniform()) ** 3 if longest else 0.0
    way = WAYS[int(rng.integers(3))]
    value = float(rng.uniform(low, high))
    end = min(at + max(duration, 0.02), CALM)
    return Event(kind, round(at, 3), round(end - at, 3) if longest else 0.0, round(value, 4), way)


def _swizzle(rng: np.random.Generator) -> list[Event]:
    """Freeze everything one by one, let it go in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    things = [("blackout", "up"), ("blackout", "down"), ("cloud_paused", "both")]
    things.append(("world_paused", "both"))
    starts = float(rng.uniform(1.0, 35.0)) + np.cumsum(rng.uniform(0.05, 0.8, 4))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.05, 1.0, 4)))
    return [
        Event(kind, round(float(a), 3), round(float(b - a), 3), 0.0, way)
        for (kind, way), a, b in zip(things, starts, ends, strict=True)
    ]


def _sometimes(rng: np.random.Generator, most: float) -> float:
    return round(float(rng.uniform(0.0, most)), 3) if rng.random() < 0.25 else 0.0
