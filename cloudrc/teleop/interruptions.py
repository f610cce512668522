# SPDX-License-Identifier: Apache-2.0

"""Tell the interruptions of a mission, as they begin and end: silence of telemetry, and HOLD.

All times are times since the mission began [s].
"""

from __future__ import annotations

from collections.abc import Iterator

from cloudrc.base.text import describe_point
from cloudrc.results.metrics.verdict import FailureCode, FlightFailure
from cloudrc.teleop.wire import EventName, RobotStatus
from cloudrc.wire.messages import GuardState

SILENCE = 1.0
"""Age above which telemetry, or the last message from cloud, is too old [s]."""
HOLD_TOLD = 0.5
"""Shortest time in HOLD that is told [s]. On a poor link the guard holds often and for less."""


class Interruption:
    """Times of one kind of interruption in a mission.

    Attributes:
        since: Beginning of the present interruption [s]; None without one.
        total: Duration of all told interruptions that have ended [s].
    """

    def __init__(self, shortest: float) -> None:
        """Tell interruptions that last for `shortest` [s] or longer."""
        self._shortest = shortest
        self.since: float | None = None
        self.total = 0.0
        self._is_told = False  # whether the present interruption lasts long enough to be told

    def lasts(self, since: float, time: float) -> bool:
        """Return whether the interruption has become long enough at `time` [s].

        It has begun at `since` [s], unless one lasts already.
        """
        self.since = since if self.since is None else self.since
        if self._is_told or time - self.since < self._shortest:
            return False
        self._is_told = True
        return True

    def end(self, time: float) -> float:
        """End the interruption at `time` [s]; return its duration [s], or 0 if it was not told."""
        lasted = time - self.since if self._is_told and self.since is not None else 0.0
        self.since, self._is_told = None, False
        self.total += lasted
        return lasted


class Interruptions:
    """Interruptions of one mission."""

    def __init__(self) -> None:
        self._silence, self._hold = Interruption(0.0), Interruption(HOLD_TOLD)

    def see(
        self, seen: RobotStatus, time: float, *, flies: bool
    ) -> Iterator[tuple[EventName, str]]:
        """Process telemetry; yield event and text of each interruption that begins or ends.

        `time` is the time since the mission began [s], `flies` whether the mission has started.
        """
        guard = f"guard in {seen.guard.name}"
        if lasted := self._silence.end(time):
            text = f"telemetry again at {time:.2f} s, after {lasted:.1f} s: {guard}"
            yield "telemetry_again", f"{text} ({seen.cause.words})"
        if seen.guard is not GuardState.HOLD or not flies:
            if lasted := self._hold.end(time):
                yield "hold_over", f"{guard} at {time:.2f} s, after {lasted:.1f} s in HOLD"
        elif self._hold.lasts(time, time):
            yield "guard_holds", f"{guard} since {self._hold.since:.2f} s ({seen.cause.words})"

    def wait(
        self, seen: RobotStatus | None, time: float, age: float, *, cloud_is_silent: bool
    ) -> Iterator[tuple[EventName, str]]:
        """Yield event and text if telemetry has become silent.

        `seen` is the newest telemetry, `age` its age [s], or the time for which this process has
        waited for it. `time` is the time since the mission began [s].
        """
        if age > SILENCE and self._silence.lasts(time - age, time):
            why = "teleop does not hear cloud" if cloud_is_silent else "cloud hears nothing"
            text = f"no telemetry since {self._silence.since:.2f} s ({why})"
            if seen is not None:
                place = describe_point(seen.position)
                text += f"; last seen at {place} m, with the guard in {seen.guard.name}"
            yield "no_telemetry", text

    def failures(self, time: float) -> tuple[FlightFailure, ...]:
        """Return the interruptions of a mission that ends at `time` [s] and is not done."""
        kinds: dict[FailureCode, tuple[Interruption, str]] = {
            "no_telemetry": (self._silence, "no telemetry"),
            "guard_held": (self._hold, "the guard was in HOLD"),
        }
        for kind, _ in kinds.values():
            kind.end(time)
        return tuple(
            FlightFailure(code, f"{text} for {kind.total:.1f} s in all")
            for code, (kind, text) in kinds.items()
            if kind.total
        )
