"""A fleet as a trial: fly it, judge its robots, and measure the median and the worst one.

If `until_failure` is set, the flight ends once a robot has failed that succeeds alone. A robot that
fails alone, without neighbours, says nothing about what it shares with them; so such a trial
succeeds if all other robots do.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from hashlib import sha256
from itertools import accumulate
from statistics import median
from typing import Any, NamedTuple

from cloudrc import assembly, source
from cloudrc.config.fleet import CellConfig
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.link.cell import CellLog
from cloudrc.outside.code import apart
from cloudrc.outside.reuse import reuse_results
from cloudrc.record.columns import Recording, RecordStore
from cloudrc.records import Control, Record
from cloudrc.report.document import Assessment, Run
from cloudrc.report.fleet import FleetFlown, cloud_numbers, fleet_document
from cloudrc.report.write import assess
from cloudrc.runs import flight
from cloudrc.runs.fleet import assemble_fleet
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.trials.fingerprint import experiment_facts, fingerprint, key_of
from cloudrc.trials.rows import Row

LATE_NS = 1_000_000_000
"""How much later than its latest time a robot must be, before it counts as late [ns]: telemetry may
end the stay at a waypoint a little early."""


class FleetTrial(NamedTuple):
    """The flight of a fleet under one condition, with one seed."""

    fingerprint: str  # of the condition and the size of the fleet
    point: dict[str, Any]  # axis -> value
    seed: int
    fleet: ResolvedExperiment  # its seed is not used
    kinds: Sequence[ResolvedExperiment]  # robot k is as number k modulo their count
    until_failure: bool = False

    @property
    def key(self) -> str:
        """16 hexadecimal digits; equal keys mean equal flights."""
        return key_of(self.fingerprint, self.seed)

    def robot(self, number: int) -> ResolvedExperiment:
        """Return the experiment of a robot in the fleet."""
        kind = self.kinds[number % len(self.kinds)]
        own = kind.fleet.model_copy(update={"robots": self.fleet.fleet.robots, "only": number})
        return kind.model_copy(update={"seed": self.seed, "fleet": own})

    def play(self) -> Row:
        """Fly, judge and measure; return the row."""
        of = {"key": self.key, "point": self.point, "seed": self.seed}
        return {**of, **flight.or_error(self._fly), "code": source.code_hash()}

    @apart()
    @reuse_results()
    def _fly(self) -> Row:
        flown = _Flight(self)
        flown.run.fly(flown.look)
        return flown.row()


def alone(robot: ResolvedExperiment) -> ResolvedExperiment:
    """Return the experiment of a robot of a fleet that shares nothing."""
    cloud = robot.cloud.model_copy(update={"cores": None})
    own = robot.fleet.model_copy(update={"robots": (robot.fleet.only or 0) + 1})
    return robot.model_copy(update={"cell": CellConfig(), "cloud": cloud, "fleet": own})


class _Flight:
    """A fleet in flight."""

    def __init__(self, trial: FleetTrial) -> None:
        self._experiment = trial.fleet.model_copy(update={"seed": trial.seed})
        self._until_failure = trial.until_failure
        numbers = range(trial.fleet.fleet.robots)
        self._robots = [trial.robot(number) for number in numbers]
        self._stores = [RecordStore() for _ in numbers]
        self._legs = [0 for _ in numbers]  # waypoint to which each flies
        self._latest_ns = [_latest_ns(robot) for robot in self._robots]
        self._judged = dict[int, Assessment]()
        self._excused = set[int]()  # numbers of robots that fail alone
        self._failures, self._text = list[str](), ""
        sinks = [partial(self._take, number) for number in numbers]
        self.run = assemble_fleet(self._experiment, self._robots, sinks)
        self._log = CellLog(self.run.cells)

    def _take(self, number: int, from_world: list[Record], from_cloud: list[Record]) -> None:
        raise_if_interrupted()
        self._stores[number].add(from_world, from_cloud)
        for record in from_cloud:
            if type(record) is Control and record.waypoint >= 0:
                self._legs[number] = record.waypoint

    def look(self, now_ns: int) -> bool:
        """Return whether the flight is over before its end; `now_ns` is the time [ns]."""
        self._log.take(now_ns)
        return self._until_failure and any(
            self._has_failed(number, now_ns) for number in range(len(self._robots))
        )

    def _has_failed(self, number: int, now_ns: int) -> bool:
        if number in self._judged or number in self._excused:
            return False
        member, leg = self.run.members[number], self._legs[number]
        if member.over() or now_ns >= member.limit_ns:
            verdict = self._judge(number).verdict
            if verdict.outcome == "success":
                return False
            codes = [each.code for each in verdict.failures]
            text = verdict.failures[0].text
        elif now_ns > self._latest_ns[number][leg]:
            codes = ["timed_out"]
            text = f"at waypoint {leg + 1} after {now_ns / 1e9:.0f} s: the time limit is too near"
        else:
            return False
        if not _succeeds(alone(self._robots[number])):
            self._excused.add(number)
            return False
        self._failures, self._text = codes, f"robot {number}: {text}"
        return True

    def _judge(self, number: int) -> Assessment:
        if number not in self._judged:
            robot, recording = self._robots[number], Recording(records=self._stores[number])
            run = Run("virtual", "virtual", notes=assembly.virtual_notes(robot))
            self._judged[number] = assess(recording, robot, run, robot.report.metrics)
        return self._judged[number]

    def row(self) -> Row:
        """Measure all robots up to now; return the row."""
        rate = self._experiment.cloud.command_rate_hz
        flown = FleetFlown(self._experiment, self._log, cloud_numbers(self.run, rate))
        rates = list[float]()  # of commands that reached the robot's controller [1/s]
        for number, robot in enumerate(self._robots):
            found = self._judge(number)
            flown.add(found.flight.recording, robot, found.document)
            duration = found.numbers.get("duration")
            time = duration.value if duration else self.run.now_ns * 1e-9
            applied = found.numbers.get("commands_applied")
            rates.append(applied.value / time if applied and time else 0.0)
        document = fleet_document(flown)
        if not self._until_failure:
            failed = [found for found in self._judged.values() if found.verdict.failures]
            codes = {each.code for found in failed for each in found.verdict.failures}
            self._failures = sorted(codes)
            self._text = failed[0].verdict.failures[0].text if failed else ""
        numbers = {
            f"{name}_{which}": value
            for which in ("median", "worst")
            for name, value in document[which].items()
        }
        ways: list[Row] = document["cell"]
        busiest = max(ways, key=lambda way: way["load"], default={})
        names = "load", "wait_mean_ms", "nddd1_ms"
        hashes = "".join(robot["records_sha256"] for robot in document["robots"])
        return {
            "verdict": "failure" if self._failures else "success",
            "failures": self._failures,
            "text": self._text,
            "numbers": {
                **numbers,
                **{"rate_hz_median": median(rates), "rate_hz_worst": min(rates)},
                **{name: busiest[name] for name in names if busiest.get(name) is not None},
                **({"cloud_hz": document["cloud"]["rate_hz"]} if document["cloud"] else {}),
                "succeeded": document["succeeded"],
                "fail_alone": len(self._excused),
                "flown_s": self.run.now_ns * 1e-9,
            },
            "records_sha256": sha256(hashes.encode()).hexdigest(),
        }


_ALONE = dict[str, bool]()  # of this process: fleets of one seed have the same robots


def _succeeds(robot: ResolvedExperiment) -> bool:
    """Return whether a robot alone succeeds."""
    key = fingerprint(experiment_facts(robot), robot.seed)
    if key not in _ALONE:
        _ALONE[key] = flight.fly_in_memory(robot).verdict.outcome == "success"
    return _ALONE[key]


def _latest_ns(robot: ResolvedExperiment) -> list[int]:
    """Return until when a robot must have reached each waypoint, so that it can end in time [ns].

    It has to stay at each of the later ones for a time.
    """
    plan = assembly.build_plan(robot)
    stays = [leg.dwell for leg in plan.legs[:0:-1]]
    latest = [round((plan.time_limit - stay) * 1e9) for stay in accumulate(stays, initial=0.0)]
    return [each + LATE_NS for each in latest[::-1]]
