"""A fleet as a trial: fly it, judge its robots, and measure the median and the worst one.

If `until_failure` is set, the flight ends once a robot has failed that succeeds alone. A robot that
fails alone, without neighbours, says nothing about what it shares with them; so such a trial
succeeds if all other robots do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from hashlib import sha256
from itertools import accumulate
from statistics import median
from typing import Any, NamedTuple

from cloudrc import assembly
from cloudrc.config.fleet import CellConfig
from cloudrc.config.overrides import OUTSIDE
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.outside.code import apart
from cloudrc.outside.reuse import reuse_results
from cloudrc.record.columns import Recording, RecordStore
from cloudrc.records import Control, Record
from cloudrc.report.document import Assessment, Run
from cloudrc.report.fleet import FleetFlown, cloud_numbers, fleet_document
from cloudrc.report.write import assess
from cloudrc.runs import flight
from cloudrc.runs.experiment import check_no_seed, check_world, load, robots_of
from cloudrc.runs.fleet import assemble_fleet
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.trials.plan import PlannedFlight
from cloudrc.trials.rows import Row

LATE_NS = 1_000_000_000
"""How much later than its latest time a robot must be, before it counts as late [ns]: telemetry may
end the stay at a waypoint a little early."""


class FleetTrial(NamedTuple):
    """The flight of a fleet under one condition, with one seed."""

    flight: PlannedFlight  # of the fleet
    robots: Sequence[ResolvedExperiment]  # their seeds are not used
    until_failure: bool = False

    @property
    def key(self) -> str:
        """16 hexadecimal digits; equal keys mean equal flights."""
        return self.flight.key

    def with_seed(self, seed: int) -> FleetTrial:
        """Return the flight of the same fleet with another seed."""
        return self._replace(flight=self.flight._replace(seed=seed))

    def play(self) -> Row:
        """Fly, judge and measure; return the row."""
        return self.flight.row(flight.or_error(self._fly))

    @apart()
    @reuse_results()
    def _fly(self) -> Row:
        fleet = _Flight(self)
        fleet.run.fly(fleet.flown.log, fleet.is_over)
        return fleet.row()


def load_trial(
    experiment: str, settings: Sequence[str], point: Mapping[str, Any], *, until_failure: bool
) -> FleetTrial:
    """Load and check a fleet and each of its robots, for a flight with seed 1.

    `point` are axis -> value.
    """
    check_no_seed(settings)
    fleet = load(experiment, settings, fleets=True)
    if fleet.cloud.controller.name in OUTSIDE:
        raise problem_at("cloud.controller", "flies with `cloudrc run` only")
    robots = robots_of(fleet, experiment, settings)
    for robot in robots:
        check_world(robot.world, turns=robot.mission.turns)
    known = fingerprint(*map(experiment_facts, (fleet, *robots)))
    return FleetTrial(PlannedFlight(known, {**point}, 1, fleet), robots, until_failure)


def alone(robot: ResolvedExperiment) -> ResolvedExperiment:
    """Return the experiment of a robot of a fleet that shares nothing."""
    cloud = robot.cloud.model_copy(update={"cores": None})
    own = robot.fleet.model_copy(update={"robots": (robot.fleet.only or 0) + 1})
    return robot.model_copy(update={"cell": CellConfig(), "cloud": cloud, "fleet": own})


class _Flight:
    """A fleet in flight."""

    def __init__(self, trial: FleetTrial) -> None:
        self.flown, seed = FleetFlown(trial.flight.experiment), trial.flight.seed
        self._until_failure = trial.until_failure
        self._robots = [robot.model_copy(update={"seed": seed}) for robot in trial.robots]
        self._stores = [RecordStore() for _ in self._robots]
        self._legs = [0 for _ in self._robots]  # waypoint to which each flies
        self._latest_ns = [_latest_ns(robot) for robot in self._robots]
        self._judged = dict[int, Assessment]()
        self._flying = {*range(len(self._robots))}  # numbers of those that may still fail
        self._fail_alone = 0
        self._failures, self._text = list[str](), ""
        sinks = [partial(self._take, number) for number in self._flying]
        self.run = assemble_fleet(self.flown.experiment, self._robots, sinks)

    def _take(self, number: int, from_world: list[Record], from_cloud: list[Record]) -> None:
        raise_if_interrupted()
        self._stores[number].add(from_world, from_cloud)
        for record in from_cloud:
            if type(record) is Control and record.waypoint >= 0:
                self._legs[number] = record.waypoint

    def is_over(self, now_ns: int) -> bool:
        """Return whether the flight is over before its end; `now_ns` is the time [ns]."""
        return self._until_failure and any(self._fails(each, now_ns) for each in [*self._flying])

    def _fails(self, number: int, now_ns: int) -> bool:
        """Return whether a robot that succeeds alone has failed, or can no longer end in time."""
        member, leg = self.run.members[number], self._legs[number]
        if member.over() or now_ns >= member.limit_ns:
            failures = self._judge(number).verdict.failures
            codes, text = [each.code for each in failures], failures[0].text if failures else ""
        elif now_ns > self._latest_ns[number][leg]:
            codes = ["timed_out"]
            text = f"at waypoint {leg + 1} after {now_ns / 1e9:.0f} s: the time limit is too near"
        else:
            return False
        self._flying.remove(number)
        if not codes:
            return False
        if flight.fly_in_memory(alone(self._robots[number])).verdict.outcome != "success":
            self._fail_alone += 1
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
        flown = self.flown
        flown.cloud = cloud_numbers(self.run, flown.experiment.cloud.command_rate_hz)
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
                "fail_alone": self._fail_alone,
                "flown_s": self.run.now_ns * 1e-9,
            },
            "records_sha256": sha256(hashes.encode()).hexdigest(),
        }


def _latest_ns(robot: ResolvedExperiment) -> list[int]:
    """Return until when a robot must have reached each waypoint, so that it can end in time [ns].

    It has to stay at each of the later ones for a time.
    """
    plan = assembly.build_plan(robot)
    stays = [leg.dwell for leg in plan.legs[:0:-1]]
    latest = [round((plan.time_limit - stay) * 1e9) for stay in accumulate(stays, initial=0.0)]
    return [each + LATE_NS for each in latest[::-1]]
