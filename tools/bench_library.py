"""Measure the link as a library: the speed of its tables, and the cost of `Networked`.

Run as `python -m tools.bench_library`. Other programs on the machine make the numbers smaller.
"""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np

from cloudrc.config.shipped import names
from cloudrc.gym import Networked
from cloudrc.link import (
    Blackout,
    Change,
    DirectionProfile,
    GilbertElliott,
    LinkProfile,
    OneWay,
    read_profile,
)

PACKETS = 200_000
STEPS = 20_000
REPEATS = 5
_UNIFORM = DirectionProfile(delay_ms=70.0, jitter_ms=40.0, loss=0.1)
_ALL = DirectionProfile(
    delay_ms=70.0,
    jitter_ms=40.0,
    distribution="pareto",
    correlation=0.5,
    loss=GilbertElliott(0.01, 0.1, delay_bad_ms=3.0),
    duplicate=0.1,
    reorder=0.1,
    corrupt=0.1,
    rate_kbit=100.0,
    changes=(Change(1.0, delay_ms=3.0),),
    blackouts=(Blackout(2.0, 1.0),),
)


def speed(profile: DirectionProfile) -> float:
    """Return the largest number of packets in a second of processor time [1/s]."""
    way, best = OneWay(profile, 1, uplink=True), 0.0
    for _ in range(REPEATS):
        start = time.process_time()
        way.table(PACKETS, 0.01)
        best = max(best, PACKETS / (time.process_time() - start))
    return best


class Trivial(gymnasium.Env[Any, Any]):
    """An environment that does nothing."""

    dt = 0.01
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (4,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def __init__(self) -> None:
        self._nothing = np.zeros(4, np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        return self._nothing, {}

    def step(self, action: Any) -> Any:
        """Do nothing."""
        return self._nothing, 0.0, False, False, {}


def cost(env: gymnasium.Env[Any, Any]) -> float:
    """Return the shortest processor time of a step [s]."""
    action, best = np.zeros(2, np.float32), 1.0
    for _ in range(REPEATS):
        env.reset()
        start = time.process_time()
        for _ in range(STEPS):
            env.step(action)
        best = min(best, (time.process_time() - start) / STEPS)
    return best


def main() -> None:
    """Print a line for each shipped profile and for two made ones, and for steps of `Networked`."""
    made = {"uniform, 10 % loss": _UNIFORM, "all keys at once": _ALL}
    profiles = {name: LinkProfile(one, one) for name, one in made.items()}
    profiles |= {name: read_profile(name) for name in names("profile")}
    for name, profile in profiles.items():
        print(f"{name:20} {speed(profile.uplink) * 1e-6:8.2f} million packets a second")
    bare = cost(Trivial())
    for name in ("ideal", "paper-p3", "lte"):
        added = cost(Networked(Trivial(), name)) - bare
        print(f"Networked, {name:10} {added * 1e6:8.2f} us added to a step")


if __name__ == "__main__":
    main()
