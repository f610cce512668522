"""Judge a mission by its outcome and by what telemetry showed, and derive its exit code.

The rules, codes and words are those of a run's report.
Deviation: of the timing only the real-time factor is judged, because teleop does not see lateness.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any, Literal

from cloudrc.teleop.wire import Outcome, RobotStatus

REAL_TIME_FACTOR_MIN = 0.95
"""Least valid real-time factor [1]; below it the simulated robot was slower than its network.
Source: docs/reference/control.md, "Real-time factor"."""
EXIT_CODES = {"success": 0, "failure": 1, "invalid": 6, "interrupted": 130}
"""Exit code of each outcome. Source: docs/reference/control.md, "Exit codes"."""
AWAY = -1
"""Value that replaces a slip [ns] until this teleop process has received telemetry from world."""


@dataclass(frozen=True, slots=True)
class Failure:
    """One broken rule: a code for programs and a text for people."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a mission.

    Attributes:
        outcome: Outcome as in report.json.
        failures: All broken rules.
    """

    outcome: Literal["success", "failure", "invalid", "interrupted"]
    failures: tuple[Failure, ...] = ()

    @property
    def exit_code(self) -> int:
        """Exit code of a Job that flew the mission."""
        return EXIT_CODES[self.outcome]

    def as_json(self) -> dict[str, Any]:
        """Return the verdict for the API and the journal."""
        failures = [asdict(failure) for failure in self.failures]
        return {"outcome": self.outcome, "exit_code": self.exit_code, "failures": failures}


@dataclass(frozen=True, slots=True)
class Criteria:
    """Requirements of a mission in addition to its waypoints.

    Attributes:
        contact: Whether the arm's tip has to touch the board.
        contact_speed_max: Limit of the speed at the touch [m/s].
    """

    contact: bool
    contact_speed_max: float


@dataclass(frozen=True, slots=True)
class MissionObservations:
    """Contacts and slip during a mission, computed from telemetry.

    Attributes:
        pipe_contacts: Last count of contacts in telemetry.
        pipe_touches: Number of contacts since the mission began.
        touch_before: Speed of an earlier mission's touch in telemetry [m/s]; None if none.
        touch_speed: Speed of this mission's touch [m/s]; None if the board was not touched.
        slip_began_ns: World's slip when the mission began [ns], plus the slip while teleop was
            away, which does not count.
        slip_ns: World's slip in the last telemetry [ns]; AWAY after a restart of teleop.
    """

    pipe_contacts: int = 0
    pipe_touches: int = 0
    touch_before: float | None = None
    touch_speed: float | None = None
    slip_began_ns: int = 0
    slip_ns: int = 0

    @classmethod
    def begin(cls, seen: RobotStatus) -> MissionObservations:
        """Begin with the telemetry at the start of the mission."""
        before = _known(seen.touch_speed)
        return cls(seen.pipe_contacts, 0, before, None, seen.slip_ns, seen.slip_ns)

    def see(self, seen: RobotStatus) -> MissionObservations:
        """Process new telemetry; return the same object if nothing has changed."""
        touch = _known(seen.touch_speed)
        if self.touch_speed is not None or touch == self.touch_before:
            touch = self.touch_speed
        new = seen.pipe_contacts - self.pipe_contacts
        if new < 0:  # the robot was reset to its spawn and counts from 0
            new = seen.pipe_contacts
        if not new and touch == self.touch_speed and seen.slip_ns == self.slip_ns:
            return self
        return replace(
            self,
            pipe_contacts=seen.pipe_contacts,
            pipe_touches=self.pipe_touches + new,
            touch_speed=touch,
            slip_began_ns=self.slip_began_ns + (seen.slip_ns if self.slip_ns == AWAY else 0),
            slip_ns=seen.slip_ns,
        )

    def after_restart(self) -> MissionObservations:
        """Continue after a restart of teleop; the slip in between does not count."""
        return replace(self, slip_began_ns=self.slip_began_ns - self.slip_ns, slip_ns=AWAY)

    def news(self, before: MissionObservations, elapsed: float) -> Iterator[tuple[str, str]]:
        """Yield event and text of each new contact at `elapsed` [s]."""
        if self.pipe_touches > before.pipe_touches:
            yield "pipe_touched", f"the robot touched a pipe at {elapsed:.2f} s"
        if self.touch_speed != before.touch_speed:
            text = f"board touched at {elapsed:.2f} s with {self.touch_speed:.2f} m/s"
            yield "board_touched", text


def judge(
    outcome: Outcome,
    witness: MissionObservations,
    criteria: Criteria,
    *,
    waypoints: int,
    elapsed: float,
) -> Verdict:
    """Judge a mission that has ended.

    Args:
        outcome: How the mission ended.
        witness: Contacts and slip during the mission.
        criteria: Additional requirements.
        waypoints: Number of waypoints.
        elapsed: Duration of the mission [s].
    """
    if outcome.code == "cancelled":  # unreached waypoints are no failure then
        harm = tuple(_harm(witness))
        return Verdict("interrupted", (Failure(outcome.code, outcome.text), *harm))
    broken = tuple(_broken(outcome, witness, criteria, waypoints))
    slow = tuple(_not_real_time(witness, elapsed))
    if slow:
        return Verdict("invalid", slow + broken)
    return Verdict("failure" if broken else "success", broken)


def _broken(
    outcome: Outcome, witness: MissionObservations, criteria: Criteria, waypoints: int
) -> Iterator[Failure]:
    if not outcome.success:
        yield Failure(outcome.code, outcome.text)
    if outcome.reached < waypoints:
        text = f"{outcome.reached} of {waypoints} waypoints reached"
        yield Failure("waypoint_not_reached", text)
    yield from _harm(witness)
    if not criteria.contact:
        return
    speed, limit = witness.touch_speed, criteria.contact_speed_max
    if speed is None:
        yield Failure("board_not_touched", "the arm never touched the board")
    elif speed >= limit:
        text = f"the tip met the board at {speed:.2f} m/s, not below {limit:g} m/s"
        yield Failure("contact_too_fast", text)


def _harm(witness: MissionObservations) -> Iterator[Failure]:
    if witness.pipe_touches:
        times = f" ({witness.pipe_touches} times)" if witness.pipe_touches > 1 else ""
        yield Failure("pipe_touched", f"the robot touched a pipe{times}")


def _not_real_time(witness: MissionObservations, elapsed: float) -> Iterator[Failure]:
    slipped = (witness.slip_ns - witness.slip_began_ns) * 1e-9
    factor = 1.0 - slipped / elapsed if elapsed > 0 else 1.0
    if factor < REAL_TIME_FACTOR_MIN:
        text = (
            f"real-time factor {factor:.3f} is below {REAL_TIME_FACTOR_MIN}: "
            "give world more processor time"
        )
        yield Failure("not_real_time", text)


def _known(speed: float) -> float | None:
    return speed if isfinite(speed) else None
