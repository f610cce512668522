"""Tell the interruptions of a mission, as they begin and end: silence of telemetry, and HOLD.

All times are times since the mission began [s].
"""

from __future__ import annotations

from collections.abc import Iterator

from cloudrc.messages import GuardState
from cloudrc.metrics.verdict import FlightFailure
from cloudrc.teleop.wire import RobotStatus

SILENCE = 1.0
"""Age above which telemetry, or the last message from cloud, is too old [s]."""
HOLD_TOLD = 0.5
"""Shortest time in HOLD that is told [s]. On a poor link the guard holds often and for less."""


class Interruption:
    """Times of one kind of interruption in a mission."""

    def __init__(self, shortest: float) -> None:
        """Tell interruptions that last for `shortest` [s] or longer."""
        self._shortest = shortest
        self.since: float | None = None  # beginning of the present interruption [s]; None: none
        self.is_told = False  # whether the present interruption lasts long enough to be told
        self._first, self._total = 0.0, 0.0  # of the told ones: beginning of the first; sum [s]

    def lasts(self, since: float, time: float) -> bool:
        """Return whether the interruption has become long enough at `time` [s].

        It has begun at `since` [s], unless one lasts already.
        """
        self.since = since if self.since is None else self.since
        if self.is_told or time - self.since < self._shortest:
            return False
        self._first = self._first if self._total else self.since
        self.is_told = True
        return True

    def end(self, time: float) -> float:
        """End the interruption at `time` [s]; return its duration [s], or 0 if it was not told."""
        lasted = time - self.since if self.is_told and self.since is not None else 0.0
        self.since, self.is_told = None, False
        self._total += lasted
        return lasted

    def summary(self, time: float) -> str:
        """Return when the told interruptions were, up to `time` [s]; "" for none."""
        if self.is_told and not self._total:
            return f"since {self.since:.2f} s"
        total = self._total + (time - self.since if self.is_told and self.since is not None else 0)
        return f"for {total:.1f} s in all, first from {self._first:.2f} s" if total else ""


class Interruptions:
    """Interruptions of one mission."""

    def __init__(self) -> None:
        self._silence, self._hold = Interruption(0.0), Interruption(HOLD_TOLD)

    def see(self, seen: RobotStatus, time: float, *, flies: bool) -> Iterator[tuple[str, str]]:
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
            return
        if self._hold.lasts(time, time):
            yield "guard_holds", f"{guard} since {self._hold.since:.2f} s ({seen.cause.words})"

    def wait(
        self, seen: RobotStatus | None, time: float, age: float, *, cloud_is_silent: bool
    ) -> Iterator[tuple[str, str]]:
        """Yield event and text if telemetry has become silent.

        `seen` is the newest telemetry, `age` its age [s], or the time for which this process has
        waited for it. `time` is the time since the mission began [s].
        """
        if age > SILENCE and self._silence.lasts(time - age, time):
            why = "teleop does not hear cloud" if cloud_is_silent else "cloud hears nothing"
            text = f"no telemetry since {self._silence.since:.2f} s ({why})"
            if seen is not None:
                place = ", ".join(f"{value:.2f}" for value in seen.position)
                text += f"; last seen at ({place}) m, with the guard in {seen.guard.name}"
            yield "no_telemetry", text

    def failures(self, time: float) -> tuple[FlightFailure, ...]:
        """Return the interruptions of a mission that ends at `time` [s] and is not done."""
        found = []
        if when := self._silence.summary(time):
            found.append(FlightFailure("no_telemetry", f"no telemetry {when}"))
        if when := self._hold.summary(time):
            found.append(FlightFailure("guard_held", f"the guard was in HOLD {when}"))
        return tuple(found)
