"""Judge a run and build the documents report.json and environment.json.

The verdict is the first of these that applies:

- `interrupted`: the run was stopped, or its recording ends before the mission;
- `invalid`: the run did not keep real time although it had to, so its numbers mean nothing;
- `failure`: a criterion of success is not met; each one is listed with time and place;
- `success`: all waypoints reached within the time limit, the board touched slowly enough, no pipe
  touched, the guard only in TRACK or HOLD, world never restarted.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from math import inf
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cloudrc.config.load import ResolvedExperiment, fingerprint
from cloudrc.files import write_atomically
from cloudrc.messages import GuardState, Vector
from cloudrc.metrics import Flight, Number
from cloudrc.metrics.mission import first_touch
from cloudrc.records import REAL_TIME_FACTOR_MIN

SLIP_MAX = 0.25
"""Most time that world's clock may lose in a valid flight [s]: the guard's default limit on the age
of a command. Above it a slow machine, not the network, could decide what the guard does."""

Outcome = Literal["success", "failure", "invalid", "interrupted"]


@dataclass(frozen=True, slots=True)
class Failure:
    """A criterion of success that is not met.

    Attributes:
        code: One word, for programs.
        text: Description for people.
        time: Time since the start of the mission [s]; None if there is no instant.
        place: True position of the base at that time [m], shape (3,); None if unknown.
    """

    code: str
    text: str
    time: float | None = None
    place: Vector | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a run: the outcome and all failures, the earliest first."""

    outcome: Outcome
    failures: tuple[Failure, ...]


def judge(
    flight: Flight, numbers: Mapping[str, Number], *, real_time: bool, interrupted: bool
) -> Verdict:
    """Judge a run.

    Args:
        flight: The recorded flight.
        numbers: Its measured numbers.
        real_time: True if the run had to keep real time: any mode except virtual.
        interrupted: True if the run was stopped, or if its recording is torn.
    """
    violations = tuple(_violations(flight))
    if interrupted and flight.ending is None:
        return Verdict("interrupted", (_interruption(flight), *violations))
    codes = {failure.code for failure in violations}
    failures = [*violations, *(f for f in _unmet_goals(flight, numbers) if f.code not in codes)]
    failures.sort(key=lambda failure: inf if failure.time is None else failure.time)
    slow = tuple(_not_real_time(numbers)) if real_time else ()
    outcome: Outcome = "invalid" if slow else "failure" if failures else "success"
    return Verdict(outcome, (*slow, *failures))


def _interruption(flight: Flight) -> Failure:
    if flight.end_ns is None:
        return Failure("interrupted", "the run was stopped before the mission started")
    return _failure(flight, "interrupted", "the run ended before the mission", flight.end_ns)


def _not_real_time(numbers: Mapping[str, Number]) -> Iterator[Failure]:
    factor, slip = numbers.get("real_time_factor"), numbers.get("world_slip")
    advice = "close other programs or give the run more cores"
    if factor is None or slip is None:
        yield Failure("not_real_time", "the recording does not prove that the run kept real time")
    elif factor.value < REAL_TIME_FACTOR_MIN:
        text = f"real-time factor {factor.value:.3f} is below {REAL_TIME_FACTOR_MIN}: {advice}"
        yield Failure("not_real_time", text)
    elif slip.value > SLIP_MAX:
        text = f"world's clock lost {slip.value:.3f} s, more than {SLIP_MAX} s: {advice}"
        yield Failure("not_real_time", text)


def _unmet_goals(flight: Flight, numbers: Mapping[str, Number]) -> Iterator[Failure]:
    """Yield the goals of the mission that it did not reach."""
    if flight.start_ns is None or flight.end_ns is None:
        yield Failure("not_started", f"the robot never left the ground: {_why_grounded(flight)}")
        return
    ending = flight.ending
    if ending is None:
        yield _failure(flight, "mission_not_ended", "the mission did not end", flight.end_ns)
    elif ending[1] != "done":
        yield _failure(flight, ending[1], ending[2], ending[0])
    reached = numbers["waypoints_reached"].value if "waypoints_reached" in numbers else 0
    if reached < flight.waypoints:
        text = f"{reached:.0f} of {flight.waypoints} waypoints reached"
        yield _failure(flight, "waypoint_not_reached", text, flight.end_ns)
    if flight.criteria.contact and first_touch(flight) is None:
        yield _failure(flight, "board_not_touched", "the arm never touched the board", None)
    limit = flight.criteria.time_limit_s
    if flight.seconds(flight.end_ns) > limit:
        text = f"the mission took {flight.seconds(flight.end_ns):.1f} s, more than {limit:g} s"
        yield _failure(flight, "time_limit_exceeded", text, flight.end_ns)


def _why_grounded(flight: Flight) -> str:
    """Say why the guard never applied a command in a flight that did not start."""
    arrivals, control = flight.recording["/downlink_delay"], flight.recording["/delay_estimate"]
    if not len(control):
        return "its telemetry or cloud's answers were lost, so cloud computed no command"
    if not len(arrivals):
        return "no command arrived"
    # The start of a mission opens a new session: commands of older sessions do not count.
    last = arrivals["epoch"] == arrivals["epoch"].max()
    if arrivals["used"][last].any():
        return "fresh commands arrived, but no request to start"
    keys = zip(control["epoch"], control["counter"], strict=True)
    basis_ns = dict(zip(keys, control["basis_stamp_ns"], strict=True))
    rows = (arrivals[name][last] for name in ("epoch", "counter", "stamp_ns"))
    ages_ns = [
        stamp_ns - basis_ns[epoch, counter]
        for epoch, counter, stamp_ns in zip(*rows, strict=True)
        if (epoch, counter) in basis_ns
    ]
    if not ages_ns:
        return "no fresh command arrived"
    return (
        f"the odometry behind each command was {min(ages_ns) * 1e-9:.3f} s old or older when the"
        " command arrived, above the limit guard.command_age_max_ms; shorten the delay or raise"
        " the limit"
    )


def _violations(flight: Flight) -> Iterator[Failure]:
    """Yield events that must not happen at any time of the flight."""
    touch, speed_max = first_touch(flight), flight.criteria.contact_speed_max_mps
    if touch is not None and flight.criteria.contact:
        speed = float(np.linalg.norm(touch["tip_velocity"]))
        if speed >= speed_max:
            text = f"the tip met the board at {speed:.2f} m/s, not below {speed_max:g} m/s"
            yield _failure(flight, "contact_too_fast", text, int(touch["stamp_ns"]))
    contact = flight.during("/contact")
    for body in sorted({str(body) for body in contact["body"] if str(body).startswith("pipe")}):
        stamps = contact["stamp_ns"][contact["body"] == body]
        text = f"the robot touched {body}"
        if len(stamps) > 1:
            text += f" ({len(stamps)} times)"
        yield _failure(flight, "pipe_touched", text, int(stamps[0]))
    guard, before = flight.during("/guard"), None
    for stamp_ns, state, cause in zip(
        guard["stamp_ns"], guard["state"], guard["cause"], strict=True
    ):
        before, repeated = state, state == before  # a touch-down repeats LAND
        if state not in (GuardState.TRACK, GuardState.HOLD) and not repeated:
            text = f"the guard went to {GuardState(state).name}: {cause}"
            yield _failure(flight, "guard_intervened", text, int(stamp_ns))
    session = flight.during("/session")
    for stamp_ns, end, cause in zip(
        session["stamp_ns"], session["end"], session["cause"], strict=True
    ):
        # The session that the mission itself opens may have the stamp of the start.
        if end == "world" and stamp_ns > (flight.start_ns or 0):
            text = f"world opened a new session in flight: {cause}"
            yield _failure(flight, "world_restarted", text, int(stamp_ns))


def _failure(flight: Flight, code: str, text: str, stamp_ns: int | None) -> Failure:
    """Make a failure with time and place, given its instant [ns]."""
    if stamp_ns is None:
        return Failure(code, text)
    x, y, z = flight.true_position(np.array([stamp_ns]))[0]
    place = (float(x), float(y), float(z)) if np.isfinite((x, y, z)).all() else None
    return Failure(code, text, float(flight.seconds(stamp_ns)), place)


SCHEMA_VERSION = 1
PACKAGES = (
    "cloudrc",
    "mujoco",
    "numpy",
    "pydantic",
    "pyyaml",
    "cryptography",
    "mcap",
    "rosbags",
    "matplotlib",
)
"""Packages whose version can change the results of a run or its report."""


@dataclass(frozen=True, slots=True)
class Run:
    """Facts about a run that are not in its recording.

    Attributes:
        mode: "virtual", "local" or "cluster".
        shaper: What emulated the link: "virtual", "relay" or "netem".
        records_sha256: Hash of all records in virtual time, of all messages in real time, by
            `record.hash`; None if the recording is incomplete.
        interrupted: True if the run was stopped.
        notes: Notes for the reader, a sentence each.
    """

    mode: str
    shaper: str
    records_sha256: str | None = None
    interrupted: bool = False
    notes: tuple[str, ...] = ()


def report_document(
    run: Run,
    experiment: ResolvedExperiment,
    verdict: Verdict,
    numbers: Mapping[str, Number],
    notes: Sequence[str],
    *,
    clock_offset: Mapping[str, Any] | None,
    complete: bool,
) -> dict[str, Any]:
    """Build report.json.

    Args:
        run: Facts about the run that are not in its recording.
        experiment: The experiment.
        verdict: The verdict on the run.
        numbers: Measured numbers; unknown ones are absent.
        notes: Notes for the reader, a sentence each.
        clock_offset: Document by `clock_offset_document`.
        complete: False if the recording is torn.
    """
    document = {
        "schemaVersion": SCHEMA_VERSION,
        "verdict": verdict.outcome,
        "failures": [_failure_document(failure) for failure in verdict.failures],
        "experiment": experiment.name,
        "config_sha256": fingerprint(experiment),
        "mode": run.mode,
        "seed": experiment.seed,
        "shaper": run.shaper,
        "records_sha256": run.records_sha256,
        "numbers": {
            name: {"value": number.value, "unit": number.unit} for name, number in numbers.items()
        },
        "clock_offset": clock_offset,
        "complete": complete,
        "notes": list(notes),
    }
    return _known(document)


def clock_offset_document(metadata: Mapping[str, str]) -> dict[str, Any] | None:
    """Describe how cloud's stamps were shifted to world's clock.

    Args:
        metadata: Metadata of the recording.

    Returns:
        The method and, if known, the uncertainty; None if both ends share a clock.
    """
    method = metadata.get("clock_offset_method", "same clock")
    if method == "same clock":
        return None
    uncertainty_ns = metadata.get("clock_offset_uncertainty_ns")
    known = None if uncertainty_ns is None else {"value": int(uncertainty_ns) * 1e-9, "unit": "s"}
    return _known({"method": method, "uncertainty": known})


def environment_document() -> dict[str, Any]:
    """Describe the software and hardware that made the report, without user or host names."""
    return {
        "schemaVersion": SCHEMA_VERSION,
        "python": platform.python_version(),
        "packages": {name: version for name in PACKAGES if (version := _version(name))},
        "system": f"{platform.system()} {platform.release()}",
        "architecture": platform.machine(),
        "processor": _processor(),
        "cores": os.cpu_count(),
    }


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document as JSON; raise ValueError if a number is not finite."""
    text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False)
    write_atomically(path, f"{text}\n".encode())


def _failure_document(failure: Failure) -> dict[str, Any]:
    place = None if failure.place is None else list(failure.place)
    return _known({**asdict(failure), "place": place})


def _known(entries: dict[str, Any]) -> dict[str, Any]:
    """Remove unknown entries, which are None: they are absent, never zero or null."""
    return {name: value for name, value in entries.items() if value is not None}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """Read the processor's model from /proc/cpuinfo, else ask Python."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor())
