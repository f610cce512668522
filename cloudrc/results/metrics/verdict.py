# SPDX-License-Identifier: Apache-2.0

"""Judge a mission: success, failure, invalid or interrupted.

The first matching outcome of this list is the verdict:

- `interrupted`: the run was stopped or the mission was cancelled before its end.
- `invalid`: the run had to keep real time but did not, so its numbers mean nothing. Or no failure
  is known, but the recording is incomplete.
- `failure`: at least one criterion of success is not met. Each such criterion is listed with time
  and place.
- `success`: all waypoints, or the last setpoint of a file, were reached within the time limit, what
  the mission has to touch was touched slowly enough, no obstacle was touched, the guard was only in
  TRACK or HOLD, and world never restarted.

The same rules apply to two kinds of evidence. The report uses the recorded truth
(`flight_evidence`). Teleop uses telemetry (`Observations`), which arrives late and contains less.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from cloudrc.base.errors import DiskFullError
from cloudrc.base.rounding import exceeds
from cloudrc.results.metrics.counters import growth
from cloudrc.results.metrics.definitions import real_time_factor
from cloudrc.results.metrics.flight import Flight, between, rows_of
from cloudrc.results.metrics.follow import target_lost
from cloudrc.results.metrics.measure import Number
from cloudrc.results.metrics.mission import missed_end, obstacle_contacts, reported, unconfirmed
from cloudrc.results.metrics.response import responses
from cloudrc.results.record import STOPPED
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.holes import describe, unasked
from cloudrc.wire.messages import Cause, GuardState, Vector
from cloudrc.wire.records import (
    CONTROLLER_LOST,
    REAL_TIME_FACTOR_MIN,
    ControllerLost,
    MissionFailure,
)

if TYPE_CHECKING:
    from cloudrc.config.schema import Touch

SLIP_MAX = 0.25
"""Largest time that world's clock may lose in a valid flight [s]: the guard's default limit on the
age of a command. With a larger loss, the guard might react to a slow machine."""
EXIT_CODES = {"success": 0, "failure": 1, "invalid": 6, "interrupted": 130}
"""Exit code of each outcome. Source: docs/trouble.md, "What the exit code says"."""
PLUGIN_FAILURES_MAX = 0.01
"""Largest share of periods in which a plug-in may fail in a valid flight, in [0, 1]."""
FailureCode: TypeAlias = Literal[
    MissionFailure,
    ControllerLost,
    "cancelled",
    "contact_too_fast",
    "disk_full",
    "guard_held",
    "guard_intervened",
    "interrupted",
    "mission_not_ended",
    "no_telemetry",
    "not_real_time",
    "not_recorded",
    "not_settled",
    "not_started",
    "not_touched",
    "obstacle_touched",
    "plugin_failed",
    "recording_incomplete",
    "target_lost",
    "time_limit_exceeded",
    "unstable",
    "waypoint_not_reached",
]
"""Codes of failures; docs/verdict.md explains them."""
BROKEN_OFF: tuple[FailureCode, ...] = ("interrupted", "cancelled", "disk_full")
"""Codes of an `Ending` that interrupts a mission; the goals then need not be met."""
NOT_STARTED = (
    "the robot never left the ground, because it got no fresh commands or no request to"
    " start; look at the link: its loss, its damage (corrupt), and its delays beside"
    " guard.command_age_max_ms"
)
PROVEN_BY_ALL: tuple[FailureCode, ...] = (
    "not_recorded",
    "not_started",
    "mission_not_ended",
    "waypoint_not_reached",
    "not_touched",
)
"""Codes of failures that only a recording without holes proves: something never happened in it."""
ADVICE = "close other programs or give the run more cores"

Outcome = Literal["success", "failure", "invalid", "interrupted"]


def exit_code(report: Mapping[str, Any]) -> int:
    """Return the exit code of a run from the content of its report.json."""
    if any(failure["code"] == "disk_full" for failure in report["failures"]):
        return DiskFullError.exit_code
    return EXIT_CODES[report["verdict"]]


@dataclass(frozen=True, slots=True)
class FlightFailure:
    """A criterion of success that is not met."""

    code: FailureCode
    text: str  # for people
    time: float | None = None  # time since the start of the mission [s]; None if unknown
    place: Vector | None = None  # true position of the base at that time [m]; None if unknown


@dataclass(frozen=True, slots=True)
class FlightVerdict:
    """Outcome of a mission and all failures: `timed_out`, then the others, the earliest first."""

    outcome: Outcome
    failures: tuple[FlightFailure, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return outcome, exit code and failures for the API; of a failure only code and text."""
        failures = [{"code": each.code, "text": each.text} for each in self.failures]
        code = EXIT_CODES[self.outcome]
        return {"outcome": self.outcome, "exit_code": code, "failures": failures}


class Moment(NamedTuple):
    """An instant of a flight; unknown values are None.

    `time` is the time since the mission's start [s], `place` the true position of the base [m].
    """

    time: float | None = None
    place: Vector | None = None


UNKNOWN = Moment()


class Ending(NamedTuple):
    """How a mission ended: a code for programs, and a text for users."""

    code: Literal["done"] | FailureCode
    text: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Facts about a finished mission, on which the verdict is based."""

    waypoints: int
    reached: int  # number of waypoints reached
    wanted: Touch | None  # what the robot has to touch; None: nothing
    ending: Ending
    end: Moment = UNKNOWN
    time_limit: float = inf  # limit of the time of `end` [s]
    touch: tuple[float, Moment] | None = None  # speed of the first touch of `wanted` [m/s]
    violations: tuple[FlightFailure, ...] = ()  # other events that must not happen
    slow: str = ""  # why the run failed to keep real time; "" if it did not fail
    lost: str = ""  # what the recording has lost, in words; "" if it is complete
    unconfirmed: str = ""  # how the truth contradicts a waypoint that teleop reported; "" if not


def judge(evidence: Evidence) -> FlightVerdict:
    """Judge a mission by its evidence; the verdict lists all violations and unmet goals."""
    violations = (*_too_fast(evidence), *evidence.violations)
    if evidence.ending.code in BROKEN_OFF:
        return FlightVerdict("interrupted", (*_bad_ending(evidence), *violations))
    codes = {failure.code for failure in violations}
    unmet = [f for f in _unmet_goals(evidence) if f.code not in codes]
    proven = [f for f in unmet if not evidence.lost or f.code not in PROVEN_BY_ALL]
    failures = sorted([*violations, *proven], key=_rank)
    if evidence.slow:
        return FlightVerdict("invalid", (FlightFailure("not_real_time", evidence.slow), *failures))
    if evidence.lost and not failures:
        known = "it is not known whether the mission succeeded"
        known = known if unmet else "success as far as the recording goes"
        failure = FlightFailure("recording_incomplete", f"{known}: {evidence.lost}")
        return FlightVerdict("invalid", (failure,))
    return FlightVerdict("failure" if failures else "success", tuple(failures))


def _rank(failure: FlightFailure) -> tuple[bool, float]:
    """Return the key by which failures are sorted."""
    time = inf if failure.time is None else failure.time
    return failure.code != "timed_out", time


def _too_fast(evidence: Evidence) -> Iterator[FlightFailure]:
    """Yield a failure if the robot touched too fast what it had to touch."""
    wanted, touch = evidence.wanted, evidence.touch
    if wanted is None or touch is None or not exceeds(touch[0], wanted.speed_max_mps):
        return
    speed, moment = touch
    limit = wanted.speed_max_mps
    text = (
        f"the robot met {wanted.body} at {speed:.4g} m/s, above "
        f"mission.touch.speed_max_mps {limit:g}"
    )
    yield FlightFailure("contact_too_fast", text, *moment)


def _bad_ending(evidence: Evidence) -> Iterator[FlightFailure]:
    """Yield a failure unless the mission is done."""
    code, text = evidence.ending
    if code != "done":
        yield FlightFailure(code, text, *evidence.end)


def _unmet_goals(evidence: Evidence) -> Iterator[FlightFailure]:
    ending, end = evidence.ending, evidence.end
    yield from _bad_ending(evidence)
    if ending.code in ("not_started", "onboard_failed"):  # then the goals say nothing more
        return
    if evidence.reached < evidence.waypoints:
        text = f"{evidence.reached} of {evidence.waypoints} waypoints reached"
        text += f": {evidence.unconfirmed}" if evidence.unconfirmed else ""
        yield FlightFailure("waypoint_not_reached", text, *end)
    if evidence.wanted is not None and evidence.touch is None:
        text = f"the robot never touched {evidence.wanted.body}, which mission.touch requires"
        yield FlightFailure("not_touched", text)
    if end.time is not None and exceeds(end.time, evidence.time_limit):
        key = f"criteria.time_limit_s {evidence.time_limit:g}"
        text = f"the mission took {end.time:.4g} s, more than {key}"
        yield FlightFailure("time_limit_exceeded", text, *end)


def _obstacle_touched(name: str, count: int, moment: Moment = UNKNOWN) -> FlightFailure:
    times = f" ({count} times)" if count > 1 else ""
    return FlightFailure("obstacle_touched", f"the robot touched {name}{times}", *moment)


def _too_slow(factor: float) -> str:
    if not exceeds(REAL_TIME_FACTOR_MIN, factor):
        return ""
    return f"real-time factor {factor:.4g} is below {REAL_TIME_FACTOR_MIN}: {ADVICE}"


def flight_evidence(
    flight: Flight,
    numbers: Mapping[str, Number],
    *,
    real_time: bool,
    interrupted: bool,
    kills: int = 0,
    paused: float = 0.0,
) -> Evidence:
    """Collect the evidence for the verdict from the records and from the metrics of a flight.

    `real_time` is True if the run had to keep real time: in all modes except virtual. `interrupted`
    is True if the run was stopped.

    What the experiment has asked for is no failure by itself: the sessions and the lost records
    after `kills` of cloud, and the time for which world was `paused` [s].
    """
    recording, end_ns = flight.recording, flight.end_ns
    holes = unasked(recording.holes, kills)
    reached, touch = numbers.get("waypoints_reached"), None
    if row := flight.first_touch:
        speed = float(np.linalg.norm(row["touch_velocity"]))
        touch = speed, _moment(flight, int(row["stamp_ns"]))
    return Evidence(
        waypoints=0 if flight.mission.setpoints else flight.mission.count,
        reached=0 if reached is None else round(reached.value),
        wanted=flight.mission.touch,
        ending=_ending(flight, interrupted),
        end=UNKNOWN if end_ns is None else _moment(flight, end_ns),
        time_limit=flight.criteria.time_limit_s or inf,
        touch=touch,
        violations=tuple(_violations(flight, kills)),
        slow=_not_real_time(numbers, paused) if real_time else "",
        lost=describe(holes, flight.seconds) or ("" if recording.holes else recording.note),
        unconfirmed=unconfirmed(flight),
    )


def _violations(flight: Flight, kills: int) -> Iterator[FlightFailure]:
    """Yield a failure for each recorded event that a successful flight must not have."""
    yield from _obstacles(flight)
    yield from _onboard_failures(flight)
    yield from _interventions(flight)
    yield from _restarts(flight, kills)
    yield from plugin_failures(flight.recording, flight.span_ns)
    if lost := target_lost(flight):
        yield FlightFailure("target_lost", lost[0], *_moment(flight, lost[1]))
    if flight.criteria.settle_m is not None:
        yield from _responses(flight, flight.criteria.settle_m)
        yield from _missed_end(flight, flight.criteria.settle_m)


def _ending(flight: Flight, interrupted: bool) -> Ending:
    if flight.ending is not None:
        return Ending(*flight.ending[1:])
    for code, text in rows_of(flight.recording["/fault"], "code", "text"):
        if code in CONTROLLER_LOST:  # the runner ends a flight with this fault
            return Ending(code, text)
    if flight.recording.note and flight.recording.metadata.get(STOPPED) == "disk_full":
        text = f"the recording is cut off ({flight.recording.note}); free some space"
        return Ending("disk_full", text)
    if interrupted:
        return Ending("interrupted", "the run ended before the mission")
    if flight.recording.holes:
        return Ending("not_recorded", "the recording has lost the end of the mission")
    if flight.end_ns is None:
        return Ending("not_started", NOT_STARTED)
    return Ending("mission_not_ended", "the mission did not end")


def _moment(flight: Flight, stamp_ns: int) -> Moment:
    x, y, z = flight.true_position(np.array([stamp_ns]))[0]
    place = (float(x), float(y), float(z)) if np.isfinite((x, y, z)).all() else None
    return Moment(float(flight.seconds(stamp_ns)), place)


def _obstacles(flight: Flight, until_ns: float = inf) -> Iterator[FlightFailure]:
    """Yield a failure for each obstacle that the robot touched at or before `until_ns`."""
    touched = defaultdict[str, list[int]](list)
    for body, stamp_ns in rows_of(obstacle_contacts(flight), "body", "stamp_ns"):
        if stamp_ns <= until_ns:
            touched[body].append(stamp_ns)
    for body, stamps_ns in sorted(touched.items()):
        yield _obstacle_touched(body, len(stamps_ns), _moment(flight, stamps_ns[0]))


def _interventions(flight: Flight) -> Iterator[FlightFailure]:
    """Yield a failure for each change of the guard to GROUND, LAND or ESTOP."""
    before = None
    for stamp_ns, state, cause in rows_of(flight.during("/guard"), "stamp_ns", "state", "cause"):
        before, repeated = state, state == before  # a touch-down repeats LAND
        is_known = cause == Cause.FAILED.words  # by `_onboard_failures`
        if state not in (GuardState.TRACK, GuardState.HOLD) and not repeated and not is_known:
            text = f"the guard went to {GuardState(state).name}: {cause}"
            yield FlightFailure("guard_intervened", text, *_moment(flight, stamp_ns))


def _onboard_failures(flight: Flight) -> Iterator[FlightFailure]:
    """Yield a failure for each failure of the onboard controller, on which the guard stops."""
    starts = flight.end_ns is not None  # a robot that fails on the ground starts no mission
    faults = flight.during("/fault") if starts else flight.recording["/fault"]
    for stamp_ns, code, text in rows_of(faults, "stamp_ns", "code", "text"):
        if code == "onboard_failed":
            yield FlightFailure(code, text, *(_moment(flight, stamp_ns) if starts else UNKNOWN))


def _restarts(flight: Flight, kills: int) -> Iterator[FlightFailure]:
    """Yield a failure for each new session in flight, but for those after `kills` of cloud."""
    opened = rows_of(flight.during("/session"), "stamp_ns", "end", "cause")
    # The session that the mission itself opens may have the stamp of the start.
    of_world = [row for row in opened if row[1] == "world" and row[0] > (flight.start_ns or 0)]
    for stamp_ns, _, cause in of_world[kills:]:
        text = f"world opened a new session in flight: {cause}"
        yield FlightFailure("world_restarted", text, *_moment(flight, stamp_ns))


def plugin_failures(
    recording: Recording, span_ns: tuple[int, int] | None
) -> Iterator[FlightFailure]:
    """Yield a failure for each plug-in that failed in too many control periods, or for scans.

    `span_ns` are the begin and the end of the time that counts [ns], or None for all.
    """
    faults, calls = recording["/fault"], {"perception": "/perception"}
    for kind in ("estimator", "predictor", "controller", "perception"):
        topic = recording[calls.get(kind, "/delay_estimate")].columns
        periods = between(topic, *(span_ns or (0, inf)))
        failed = growth(recording, f"{kind}_failed", span_ns)
        share = (failed or 0.0) / max(len(periods["stamp_ns"]), 1)
        if share > PLUGIN_FAILURES_MAX:
            first = faults["text"][faults["code"] == f"{kind}_failed"]
            why = f": {first[0]}" if len(first) else ""
            shown = f"{min(share, 1.0) * 100:.4g}"
            limit = f"{PLUGIN_FAILURES_MAX:.0%}"
            text = f"cloud.{kind} failed in {shown}% of its periods, above {limit}{why}"
            yield FlightFailure("plugin_failed", text)


def _responses(flight: Flight, settle: float) -> Iterator[FlightFailure]:
    """Yield a failure if a step did not settle to `settle` [m]; another for an unstable loop."""
    found, unit = responses(flight), "step" if flight.mission.steps else "waypoint"
    whole = [step for step in found if not step.cut]
    far = [step for step in whole if exceeds(step.last_error, settle)]
    if far and flight.mission.steps:
        first = far[0]
        text = (
            f"{len(far)} of {len(whole)} steps did not settle: in step {first.waypoint + 1} the "
            f"robot was {first.last_error:.4g} m from the setpoint in the last 0.5 s, above "
            f"criteria.settle_m {settle:g} m"
        )
        yield FlightFailure("not_settled", text, first.start)
    if unstable := [step for step in found if step.unstable]:
        text = (
            f"the loop is unstable: the error oscillates without decay in {len(unstable)} of "
            f"{len(found)} {unit}s, first in {unit} {unstable[0].waypoint + 1}; lower the gains of "
            "cloud.controller, or choose another cloud.predictor"
        )
        yield FlightFailure("unstable", text, unstable[0].start)


def _missed_end(flight: Flight, settle: float) -> Iterator[FlightFailure]:
    """Yield a failure if a file of setpoints ended farther than `settle` [m] from its last one."""
    ending, away = flight.ending, missed_end(flight)
    if away is None or ending is None:
        return
    text = (
        f"setpoints flown to their end, but the robot was {away:.4g} m from the "
        f"last one, above criteria.settle_m {settle:g} m; give the robot time there: "
        "repeat the last row with a later time_s"
    )
    yield FlightFailure("not_settled", text, *_moment(flight, ending[0]))


def _not_real_time(numbers: Mapping[str, Number], paused: float) -> str:
    factor, slip = numbers.get("real_time_factor"), numbers.get("world_slip")
    if factor is None or slip is None:
        return "the recording does not prove that the run kept real time"
    if not paused and (slow := _too_slow(factor.value)):
        return slow
    lost = slip.value - paused
    if exceeds(lost, SLIP_MAX):
        return f"world's clock lost {lost:.4g} s, more than {SLIP_MAX} s: {ADVICE}"
    return ""


def operator_verdict(
    flight: Flight, evidence: Evidence, numbers: Mapping[str, Number]
) -> FlightVerdict:
    """Judge a recorded mission with only what the operator knows when the mission ends.

    A waypoint is reached if teleop reported it, and timing is judged by the real-time factor alone.
    Contacts count if telemetry reported them before the end. The time limit and violations other
    than contacts with obstacles do not count. All other facts are those of the report's `evidence`.
    """
    basis = flight.control["basis_stamp_ns"]
    seen_ns = int(basis[-1]) if len(basis) else 0
    touch, factor = flight.first_touch, numbers.get("real_time_factor")
    seen = replace(
        evidence,
        reached=len(reported(flight)),
        touch=evidence.touch if touch is not None and touch["stamp_ns"] <= seen_ns else None,
        violations=tuple(_obstacles(flight, seen_ns)),
        time_limit=inf,
        unconfirmed="",
        slow=_too_slow(factor.value) if evidence.slow and factor is not None else "",
    )
    return judge(seen)


@dataclass(frozen=True, slots=True)
class Observations:
    """Contacts in a mission, and lag of world's clock (slip), as telemetry reports them."""

    obstacle_contacts: int = 0  # number of contacts with obstacles
    first_contact: str = ""  # the first of them in words: when, where, next to what
    touch_speed: float | None = None  # of the first touch of what the mission has to touch [m/s]
    slip_ns: int = 0  # time by which world's clock fell behind while teleop ran [ns]

    def news(
        self, before: Observations, elapsed: float, body: str
    ) -> Iterator[tuple[Literal["touched", "obstacle_touched"], str]]:
        """Yield event name and text of each contact since the earlier observations `before`.

        `elapsed` is the present mission time [s]. `body` is what the mission has to touch.
        """
        if self.obstacle_contacts > before.obstacle_contacts:
            first = not before.obstacle_contacts
            where = self.first_contact if first else f"again, at {elapsed:.2f} s"
            yield "obstacle_touched", f"the robot touched an obstacle {where}"
        if self.touch_speed != before.touch_speed:
            text = f"{body} touched at {elapsed:.2f} s with {self.touch_speed:.2f} m/s"
            yield "touched", text

    def evidence(self, ending: Ending, elapsed: float, **known: Any) -> Evidence:
        """Return the evidence on a mission that ended at mission time `elapsed` [s].

        `known` sets further fields of the returned `Evidence`.
        """
        slip = self.slip_ns * 1e-9
        count = self.obstacle_contacts
        return Evidence(
            ending=ending,
            end=Moment(elapsed),
            touch=None if self.touch_speed is None else (self.touch_speed, UNKNOWN),
            violations=(_obstacle_touched(f"an obstacle {self.first_contact}", count),)
            if count
            else (),
            slow=_too_slow(real_time_factor(elapsed - slip, slip)) if elapsed > 0 else "",
            **known,
        )
