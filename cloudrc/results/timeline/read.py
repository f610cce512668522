# SPDX-License-Identifier: Apache-2.0

"""Read of a run what its timeline needs, block by block: an hour of flight takes little memory."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.files import read_json
from cloudrc.base.outside.paths import check_there
from cloudrc.base.outside.refusal import reading
from cloudrc.config.schema import Criteria, MissionConfig
from cloudrc.physics.geometry.scene import Scene
from cloudrc.results.metrics.budget import NEEDED
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.folder import check_ended, robots_in
from cloudrc.results.timeline.loops import Loop, of_document, of_flight

FILE = "timeline.json"
WHAT = "name the folder of a run, or a file"


def read_loops(run: Path) -> dict[str, Loop]:
    """Read the loop of a run, its folder or its MCAP file; of a fleet, that of each robot.

    A file that `cloudrc eval --keep timeline` has written is that of an episode. Return name ->
    loop.
    """
    if run.suffix == ".json":
        check_there(run, WHAT)
        with reading(run, "is no timeline of an episode"):
            return {"episode": of_document(read_json(run))}
    robots = robots_in(run)
    flights = {each.name: each for each in robots} or {"loop": run}
    return {name: of_flight(read_flight(each)) for name, each in flights.items()}


def read_flight(run: Path) -> Flight:
    """Read the flight of a run; only the numbers of its budget are known."""
    file = run / "mission.mcap" if run.is_dir() else run
    check_ended(file.parent)
    check_there(file, WHAT)
    flight = _flight(Recording.read_topics(file, NEEDED))
    if flight.ending is None:  # the last row of the truth is the end
        flight = _flight(Recording.read_topics(file, (*NEEDED, "/ground_truth")))
    return flight


def _flight(recording: Recording) -> Flight:
    return Flight(recording, Criteria(), MissionConfig(), Scene(""))
