"""The files for programs: what was measured and judged becomes report.json and environment.json.

The verdict: a flight, its numbers and the mode go in; success or what went wrong comes out.

Rules, in the order in which they decide:

- `interrupted`: somebody stopped the run, or its recording ends before the mission does;
- `invalid`: it was to fly in real time and did not, so its numbers mean nothing;
- `failure`: one of the rules below was broken; each broken one is listed with time and place;
- `success`: every waypoint reached, the board touched gently enough, no pipe touched, the guard
  never worse than HOLD, within the time limit, world never restarted.
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
from cloudrc.files import put
from cloudrc.messages import GuardState, Vector
from cloudrc.metrics import Flight, Number
from cloudrc.metrics.mission import first_touch
from cloudrc.records import REAL_TIME_FACTOR_MIN

SLIP_MAX = 0.25
"""World's clock may lose so much in a flight [s]: the guard's usual limit on a command's age, above
which a slow machine and not the network would decide what the guard does."""

Outcome = Literal["success", "failure", "invalid", "interrupted"]


@dataclass(frozen=True, slots=True)
class Failure:
    """One rule that was broken.

    Attributes:
        code: One word, for programs.
        text: The same for people: what, where, when.
        time: Since the start of the mission [s]; None if it has no instant.
        place: True position of the base then [m], shape (3,); None if it has none.
    """

    code: str
    text: str
    time: float | None = None
    place: Vector | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of the run: the outcome and every rule that was broken, the earliest first."""

    outcome: Outcome
    failures: tuple[Failure, ...]


def judge(
    flight: Flight, numbers: Mapping[str, Number], *, real_time: bool, interrupted: bool
) -> Verdict:
    """Judge a run.

    Args:
        flight: As recorded.
        numbers: What was measured of it.
        real_time: True if it was to keep real time: any mode but virtual.
        interrupted: True if it was stopped, or if its recording is torn.
    """
    harm = tuple(_harm(flight))
    if interrupted and flight.ending is None:
        return Verdict("interrupted", (_interruption(flight), *harm))
    told = {failure.code for failure in harm}
    broken = [*harm, *(f for f in _missed(flight, numbers) if f.code not in told)]
    broken.sort(key=lambda failure: inf if failure.time is None else failure.time)
    slow = tuple(_not_real_time(numbers)) if real_time else ()
    outcome: Outcome = "invalid" if slow else "failure" if broken else "success"
    return Verdict(outcome, (*slow, *broken))


def _interruption(flight: Flight) -> Failure:
    if flight.end_ns is None:
        return Failure("interrupted", "the run was stopped before the mission began")
    return _failure(flight, "interrupted", "the run ends before the mission does", flight.end_ns)


def _not_real_time(numbers: Mapping[str, Number]) -> Iterator[Failure]:
    factor, slip = numbers.get("real_time_factor"), numbers.get("world_slip")
    advice = "close other programs or give the run more cores"
    if factor is None or slip is None:
        yield Failure("not_real_time", "nothing was recorded that proves that it kept real time")
    elif factor.value < REAL_TIME_FACTOR_MIN:
        text = f"real-time factor {factor.value:.3f} is below {REAL_TIME_FACTOR_MIN}: {advice}"
        yield Failure("not_real_time", text)
    elif slip.value > SLIP_MAX:
        text = f"world's clock lost {slip.value:.3f} s, more than {SLIP_MAX} s: {advice}"
        yield Failure("not_real_time", text)


def _missed(flight: Flight, numbers: Mapping[str, Number]) -> Iterator[Failure]:
    """What the mission was to reach and did not."""
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
    """Say what kept the commands of a flight that never began from being flown."""
    arrivals, control = flight.recording["/downlink_delay"], flight.recording["/delay_estimate"]
    if not len(control):
        return "its telemetry or cloud's answers were lost, so cloud computed no command"
    if not len(arrivals):
        return "no command came"
    # The start opens a session of its own: what was fresh before it does not count.
    last = arrivals["epoch"] == arrivals["epoch"].max()
    if arrivals["used"][last].any():
        return "fresh commands came, but no request to start"
    keys = zip(control["epoch"], control["counter"], strict=True)
    basis_ns = dict(zip(keys, control["basis_stamp_ns"], strict=True))
    rows = (arrivals[name][last] for name in ("epoch", "counter", "stamp_ns"))
    ages_ns = [
        stamp_ns - basis_ns[epoch, counter]
        for epoch, counter, stamp_ns in zip(*rows, strict=True)
        if (epoch, counter) in basis_ns
    ]
    if not ages_ns:
        return "no fresh command came"
    return (
        f"the odometry behind each command was {min(ages_ns) * 1e-9:.3f} s old or older when the"
        " command came, beyond the limit guard.command_age_max_ms; shorten the delay or raise it"
    )


def _harm(flight: Flight) -> Iterator[Failure]:
    """What must not happen at any time."""
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
        before, repeated = state, state == before  # LAND also tells of its touch-down
        if state not in (GuardState.TRACK, GuardState.HOLD) and not repeated:
            text = f"the guard went to {GuardState(state).name}: {cause}"
            yield _failure(flight, "guard_intervened", text, int(stamp_ns))
    session = flight.during("/session")
    for stamp_ns, end, cause in zip(
        session["stamp_ns"], session["end"], session["cause"], strict=True
    ):
        # The session that the mission itself opened may carry the stamp of the start.
        if end == "world" and stamp_ns > (flight.start_ns or 0):
            text = f"world opened a new session in flight: {cause}"
            yield _failure(flight, "world_restarted", text, int(stamp_ns))


def _failure(flight: Flight, code: str, text: str, stamp_ns: int | None) -> Failure:
    """Fill in time and place of a rule that was broken at an instant [ns]."""
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
"""Those whose version can change what a run or its report says."""


@dataclass(frozen=True, slots=True)
class Run:
    """What the recording itself does not say about a run.

    Attributes:
        mode: "virtual", "local" or "cluster".
        shaper: What emulated the link: "virtual", "relay" or "netem".
        records_sha256: Of all records in virtual time, of all messages in real time, by
            `record.hash`; None if they are not all there.
        interrupted: True if somebody stopped it.
        notes: What a reader should know, a sentence each.
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
    """Put together what report.json says.

    Args:
        run: What the recording does not say.
        experiment: That was flown.
        verdict: Of it.
        numbers: Measured; what is not in it cannot be known and stays absent.
        notes: What a reader should know, a sentence each.
        clock_offset: How cloud's stamps came on world's clock, by `clock_offset_document`.
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
    """Say how cloud's stamps were put on world's clock.

    Args:
        metadata: Of the recording.

    Returns:
        The method and, where it is known, the uncertainty; None if both ends share a clock.
    """
    method = metadata.get("clock_offset_method", "same clock")
    if method == "same clock":
        return None
    uncertainty_ns = metadata.get("clock_offset_uncertainty_ns")
    known = None if uncertainty_ns is None else {"value": int(uncertainty_ns) * 1e-9, "unit": "s"}
    return _known({"method": method, "uncertainty": known})


def environment_document() -> dict[str, Any]:
    """Say on what the report was made: nothing in it names a user or a machine."""
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
    """Write a document for people and programs; numbers that are not finite are refused."""
    text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False)
    put(path, f"{text}\n".encode())


def _failure_document(failure: Failure) -> dict[str, Any]:
    place = None if failure.place is None else list(failure.place)
    return _known({**asdict(failure), "place": place})


def _known(entries: dict[str, Any]) -> dict[str, Any]:
    """Leave out what is not known: absent, never zero or null."""
    return {name: value for name, value in entries.items() if value is not None}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """The processor's model where the system tells, else what Python knows of it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor())
