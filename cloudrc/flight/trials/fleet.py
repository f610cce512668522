# SPDX-License-Identifier: Apache-2.0

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
from operator import itemgetter
from statistics import median
from typing import Any

from cloudrc.base.outside.code import apart
from cloudrc.config.fleet import CellConfig
from cloudrc.config.overrides import OUTSIDE
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight import in_memory as flight
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.flight.experiment import check_no_seed, load, robots_of
from cloudrc.flight.fleet import assemble_fleet
from cloudrc.flight.interrupts import raise_if_interrupted
from cloudrc.flight.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.rows import Row
from cloudrc.flight.virtual.flight import virtual_notes
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.report.document import Assessment, Run
from cloudrc.results.report.fleet import FleetFlown, fleet_document
from cloudrc.results.report.write import assess
from cloudrc.wire.records import Control, Record

LATE_NS = 1_000_000_000
"""How much later than its latest time a robot must be, before it counts as late [ns]: telemetry may
end the stay at a waypoint a little early."""


def plan_fleet(
    experiment: str, settings: Sequence[str], point: Mapping[str, Any], *, until_failure: bool
) -> PlannedFlight:
    """Load and check a fleet and each of its robots; return its flight with seed 1."""
    check_no_seed(settings)
    fleet = load(experiment, settings, fleets=True)
    if fleet.cloud.controller.name in OUTSIDE:
        raise problem_at("cloud.controller", "flies with `cloudrc run` only")
    robots = robots_of(fleet, experiment, settings)
    known = fingerprint(*map(experiment_facts, (fleet, *robots)))
    fly = partial(fly_fleet, robots, until_failure)
    return PlannedFlight(known, {**point}, 1, fleet, fly)


def fly_fleet(
    robots: Sequence[ResolvedExperiment], until_failure: bool, fleet: ResolvedExperiment
) -> Row:
    """Fly, judge and measure a fleet; its robots get its seed. Return the results of the row."""

    @apart()
    def fly() -> Row:
        seed = {"seed": fleet.seed}
        flown = FleetFlight(fleet, [each.model_copy(update=seed) for each in robots])
        return flown.fly(until_failure=until_failure)

    return flight.or_error(fly)


def alone(robot: ResolvedExperiment) -> ResolvedExperiment:
    """Return the experiment of a robot of a fleet that shares nothing."""
    cloud = robot.cloud.model_copy(update={"cores": None})
    own = robot.fleet.model_copy(update={"robots": (robot.fleet.only or 0) + 1})
    return robot.model_copy(update={"cell": CellConfig(), "cloud": cloud, "fleet": own})


class FleetFlight:
    """A fleet in flight."""

    def __init__(self, fleet: ResolvedExperiment, robots: Sequence[ResolvedExperiment]) -> None:
        """Build the robots, and what they share."""
        self._flown, self._robots = FleetFlown(fleet), robots
        self._stores = [RecordStore() for _ in robots]
        self._legs = [0 for _ in robots]  # waypoint to which each flies
        self._latest_ns = [_latest_ns(robot) for robot in robots]
        self._judged = dict[int, Assessment]()
        self._flying = {*range(len(robots))}  # numbers of those that may still fail
        self._fail_alone = 0
        self._failures, self._text = list[str](), ""
        sinks = [partial(self._take, number) for number in self._flying]
        self._run = assemble_fleet(fleet, robots, sinks)

    def fly(self, *, until_failure: bool) -> Row:
        """Fly to the end, or until a robot has failed that succeeds alone; return the results."""
        self._run.fly(*([self._has_failed] if until_failure else []))
        document = self._measure()
        if not until_failure and document["failures"]:
            verdicts = [found.verdict for found in self._judged.values()]
            self._failures = sorted({each.code for own in verdicts for each in own.failures})
            self._text = document["failures"][0]["text"]
        hashes = "".join(robot["records_sha256"] for robot in document["robots"])
        return {
            "verdict": "failure" if self._failures else "success",
            "failures": self._failures,
            "text": self._text,
            "numbers": self._numbers(document),
            "link_start": document["link_start"],
            "records_sha256": sha256(hashes.encode()).hexdigest(),
        }

    def _take(self, number: int, from_world: list[Record], from_cloud: list[Record]) -> None:
        raise_if_interrupted()
        self._stores[number].add(from_world, from_cloud)
        for record in from_cloud:
            if type(record) is Control and record.waypoint >= 0:
                self._legs[number] = record.waypoint

    def _has_failed(self, now_ns: int) -> bool:
        return any(self._fails(number, now_ns) for number in [*self._flying])

    def _fails(self, number: int, now_ns: int) -> bool:
        """Return whether a robot that succeeds alone has failed, or can no longer end in time."""
        member, leg = self._run.members[number], self._legs[number]
        if member.over() or now_ns >= member.limit_ns:
            failures = self._judge(number).verdict.failures
            codes: list[str] = [each.code for each in failures]
            text = failures[0].text if failures else ""
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
            run = Run("virtual", "virtual", notes=virtual_notes(robot))
            self._judged[number] = assess(recording, robot, run, robot.report.metrics)
        return self._judged[number]

    def _measure(self) -> dict[str, Any]:
        """Return the report of the fleet, from all robots up to now."""
        flown = self._flown
        flown.share(self._run)
        for number, robot in enumerate(self._robots):
            found = self._judge(number)
            flown.add(found.flight.recording, robot, found.document)
        return fleet_document(flown)

    def _numbers(self, document: Mapping[str, Any]) -> dict[str, float]:
        """Return the numbers of the row; `document` is the fleet's report."""
        end_s, rates = self._run.now_ns * 1e-9, list[float]()  # that reached each controller [1/s]
        for found in self._judged.values():
            known = {name: each.value for name, each in found.numbers.items()}
            rates.append(known.get("commands_applied", 0.0) / (known.get("duration") or end_s))
        busiest = max(document["cell"], key=itemgetter("load"), default=dict[str, float]())
        numbers = {
            **{f"{name}_median": value for name, value in document["median"].items()},
            **{f"{name}_worst": value for name, value in document["worst"].items()},
            **{"rate_hz_median": median(rates), "rate_hz_worst": min(rates)},
            **{name: busiest.get(name) for name in ("load", "wait_mean_ms", "nddd1_ms")},
            "cloud_hz": (document["cloud"] or {}).get("rate_hz"),
            **{"succeeded": document["succeeded"], "fail_alone": self._fail_alone},
            "flown_s": end_s,
        }
        return {name: value for name, value in numbers.items() if value is not None}


def _latest_ns(robot: ResolvedExperiment) -> list[int]:
    """Return until when a robot must have reached each waypoint, so that it can end in time [ns].

    It has to stay at each of the later ones for a time.
    """
    plan = build_plan(robot)
    stays = [leg.dwell for leg in plan.legs[:0:-1]]
    latest = [round((plan.time_limit - stay) * 1e9) for stay in accumulate(stays, initial=0.0)]
    return [each + LATE_NS for each in latest[::-1]]
